"""Denoising frame after frame: where history goes on, and where it begins anew."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from onespp_runtime import Denoiser

from .camera import Camera
from .cycles_frame import CyclesFrame, Image
from .supersampling import AlbedoMean, with_albedo

SAME_ALBEDO = 0.1  # largest difference between frames of one surface, of any colour
SAME_NORMAL = 0.9  # least cosine
LEAST_SHARE_SEEN = 0.15  # of surfaces that the frame before showed, too: below it is another scene


class Begin(StrEnum):
    """How a frame's history begins."""

    CONTINUED = "continued"
    GAP = "gap"  # there is no frame before, or it is of another size
    CAMERA = "camera"  # it had another camera, as by a marker
    CUT = "cut"  # it shows another scene


@dataclass
class History:
    """The denoiser of one animation, whose frames come in order."""

    detects_cuts: bool = True
    number: int | None = None  # of the last frame
    camera: str = ""
    frame: CyclesFrame | None = None
    albedo: AlbedoMean | None = None
    denoiser: Denoiser | None = None

    def denoise(self, number: int, frame: CyclesFrame, camera: Camera) -> tuple[NDArray[np.float32], Begin]:
        """The radiance (H, W, 3) of the frame."""
        begin = self.begin(number, frame, camera)
        height, width = frame.size
        if self.denoiser is None or (self.denoiser.height, self.denoiser.width) != frame.size:
            self.denoiser = Denoiser(width, height)
        if self.albedo is None or begin != Begin.CONTINUED:
            self.albedo = AlbedoMean.begin(frame)
        else:
            self.albedo = self.albedo.add(frame)
        smooth = with_albedo(frame, self.albedo.mean)
        radiance = self.denoiser.denoise(
            *(smooth.color, smooth.albedo, frame.normal, frame.depth, frame.motion),
            K=camera.pixels(height, width),
            camera_to_world=camera.camera_to_world,
            emission=frame.emission,
            samples=frame.samples,
            reset=begin != Begin.CONTINUED,
        )
        self.number, self.camera, self.frame = number, camera.name, frame
        return radiance, begin

    def begin(self, number: int, frame: CyclesFrame, camera: Camera) -> Begin:
        if self.frame is None or self.number != number - 1 or self.frame.size != frame.size:
            return Begin.GAP
        if self.camera != camera.name:
            return Begin.CAMERA
        return Begin.CUT if self.detects_cuts and share_seen(frame, self.frame) < LEAST_SHARE_SEEN else Begin.CONTINUED


def share_seen(frame: CyclesFrame, before: CyclesFrame) -> float:
    """The share of surfaces that have the same albedo and normal in the frame before; 1 where either has none."""
    rows, columns = np.nonzero(frame.depth[..., 0] > 0)
    if len(rows) == 0 or not (before.depth > 0).any():
        return 1.0
    motion = np.nan_to_num(frame.motion[rows, columns]).clip(-1e5, 1e5)
    x = np.rint(columns + motion[:, 0]).astype(np.int64)
    y = np.rint(rows + motion[:, 1]).astype(np.int64)
    height, width = frame.size
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y, rows, columns = x[inside], y[inside], rows[inside], columns[inside]

    def pair(name: str) -> tuple[Image, Image]:
        return getattr(frame, name)[rows, columns], getattr(before, name)[y, x]

    albedo, old_albedo = pair("albedo")
    normal, old_normal = pair("normal")
    same = (np.abs(albedo - old_albedo).max(axis=-1, initial=0) < SAME_ALBEDO) & (before.depth[y, x, 0] > 0)
    same &= (normal * old_normal).sum(axis=-1) > SAME_NORMAL
    return float(same.sum() / len(inside))
