"""The Frame: the one type that flows from the data set to denoisers and metrics."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from datasets.channels import ALBEDO_FLOOR, CAMERA_CHANNELS, CHANNELS, REFERENCES
from datasets.clip import WHOLE, Clip, Window
from errors import BadInput
from scenes.camera import View

Signal = Literal["total", "indirect"]


def disoccluded(motion: Tensor, dual_motion: Tensor) -> Tensor:
    """Whether what a pixel shows was hidden in the previous frame, (B, 1, H, W): vectors differ by over 1/64 px."""
    return (dual_motion - motion).abs().amax(dim=1, keepdim=True) > 1 / 64


@dataclass(frozen=True)
class Cameras:
    """What projects a frame's surfaces; float64.

    K (B, 3, 3), camera_to_world (B, 4, 4), object_to_world (B, M, 4, 4).
    """

    K: Tensor
    camera_to_world: Tensor
    object_to_world: Tensor

    @staticmethod
    def of(view: View, window: Window = WHOLE) -> "Cameras":
        K = view.K.copy()
        K[:2, 2] -= [window[1].start or 0, window[0].start or 0]
        return Cameras(*(torch.from_numpy(a)[None] for a in (K, view.camera_to_world, view.object_to_world)))

    def rot90(self, width: int) -> "Cameras":
        """The cameras that see the image turned by 90° counter-clockwise: rolled about the viewing axis.

        A position (x, y) of the image, `width` pixels wide, becomes (y, width - x).
        """
        roll = torch.eye(4, dtype=torch.float64)
        roll[:2, :2] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
        turn = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, width], [0.0, 0.0, 1.0]], dtype=torch.float64)
        return replace(self, K=turn @ self.K @ roll[:3, :3], camera_to_world=self.camera_to_world @ roll)


@dataclass(frozen=True)
class Moment:
    """What identifies a frame among those of a sequence: its size (B, H, W) and cameras."""

    shape: tuple[int, int, int]
    cameras: Cameras


@dataclass(frozen=True)
class Frame:
    """One frame of one noise realisation: tensors (B, C, H, W), float32, as attributes named like the channels.

    `direct_reference` and `indirect_reference` are (B, 2, 3, H, W), where they were asked for. Reading a channel that
    was not asked for raises BadInput. `gain` (B, 3, 1, 1) is the per-channel gain of training augmentation (RAE §4.3):
    a network multiplies its exposure by it; radiance stays as rendered.
    """

    channels: dict[str, Tensor]
    now: Cameras
    previous: Cameras
    gain: Tensor
    source: str = ""

    def __getattr__(self, name: str) -> Tensor:
        if name not in CHANNELS:
            raise AttributeError(name)
        if name not in self.channels:
            raise BadInput(f"{self.source}: the channel '{name}' was not loaded for this frame")
        return self.channels[name]

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) in pixels."""
        height, width = next(iter(self.channels.values())).shape[-2:]
        return height, width

    @property
    def shape(self) -> tuple[int, int, int]:
        """(B, H, W)."""
        return (len(self.gain), *self.size)

    @property
    def moment(self) -> Moment:
        return Moment(self.shape, self.now)

    def follows(self, moment: Moment) -> bool:
        """Whether this frame continues a sequence: of the same size, and moved to it from the cameras of `moment`.

        So a cut needs no flag: the first frame of another place names other previous cameras. Where neither camera nor
        meshes differ, as between two still shots from one place, nothing tells it: pass None as the state there.
        """
        return moment.shape == self.shape and all(
            a.shape == b.shape and torch.allclose(a, b, rtol=1e-9, atol=1e-12)
            for a, b in zip(vars(self.previous).values(), vars(moment.cameras).values(), strict=True)
        )

    @property
    def divisor(self) -> Tensor:
        """What demodulation divides by: max(albedo, 0.01), (B, 3, H, W)."""
        return self.albedo.clamp(min=ALBEDO_FLOOR)

    def finite(self) -> "Frame":
        """The frame with NaN and infinities as 0, in whatever channel: one bad pixel must not poison a filter.

        A sum tells whether there are any, at a fraction of the cost of looking at every pixel.
        """
        bad = [name for name, tensor in self.channels.items() if not torch.isfinite(tensor.sum())]
        mended = {name: torch.nan_to_num(self.channels[name], nan=0.0, posinf=0.0, neginf=0.0) for name in bad}
        return replace(self, channels=self.channels | mended) if bad else self

    def map(self, function: Callable[[Tensor], Tensor]) -> "Frame":
        """The frame with `function` of every channel."""
        return replace(self, channels={name: function(tensor) for name, tensor in self.channels.items()})

    def radiance(self, signal: Signal) -> Tensor:
        """Noisy radiance (B, 3, H, W): emission + direct + indirect, or indirect alone."""
        return self.indirect if signal == "indirect" else self.emission + self.direct + self.indirect

    def irradiance(self, signal: Signal) -> Tensor:
        """Noisy demodulated radiance (B, 3, H, W), without emission."""
        return (self.indirect if signal == "indirect" else self.direct + self.indirect) / self.divisor

    def reference_irradiance(self, signal: Signal) -> Tensor:
        """The same of the reference, mean of its halves."""
        indirect = self.indirect_reference.mean(dim=1)
        return (indirect if signal == "indirect" else self.direct_reference.mean(dim=1) + indirect) / self.divisor

    def remodulate(self, irradiance: Tensor, signal: Signal) -> Tensor:
        """Radiance of denoised irradiance: times the same divisor, plus the untouched emission for "total"."""
        radiance = irradiance * self.divisor
        return radiance + self.emission if signal == "total" else radiance

    def view_normal(self) -> Tensor:
        """Shading normals (B, 3, H, W) in view space: x right, y up, z toward the viewer."""
        rotation = self.now.camera_to_world[:, :3, :3].to(self.normal)
        flip = torch.tensor([-1.0, 1.0, -1.0]).to(self.normal)  # Mitsuba's camera looks along +z with x to the left
        return torch.einsum("bij,bihw,j->bjhw", rotation, self.normal, flip)

    def rot90(self) -> "Frame":
        """The frame turned by 90° counter-clockwise: images, motion vectors and cameras alike."""
        width = self.size[1]
        channels = {name: torch.rot90(tensor, dims=(-2, -1)) for name, tensor in self.channels.items()}
        for name in channels.keys() & {"motion", "dual_motion"}:
            dx, dy = channels[name].unbind(dim=1)
            channels[name] = torch.stack([dy, -dx], dim=1)
        return replace(self, channels=channels, now=self.now.rot90(width), previous=self.previous.rot90(width))

    def to(self, device: torch.device | str) -> "Frame":
        moved = {name: tensor.to(device) for name, tensor in self.channels.items()}
        cameras = [Cameras(*(t.to(device) for t in vars(c).values())) for c in (self.now, self.previous)]
        return replace(self, channels=moved, now=cameras[0], previous=cameras[1], gain=self.gain.to(device))

    @staticmethod
    def stack(frames: Sequence["Frame"]) -> "Frame":
        """One frame of all the frames' batches. Scenes with fewer meshes are padded with meshes at rest."""
        meshes = max(frame.now.object_to_world.shape[1] for frame in frames)

        def cameras(which: str) -> Cameras:
            items: list[Cameras] = [getattr(frame, which) for frame in frames]
            rest = torch.eye(4, dtype=torch.float64)
            poses = [
                torch.cat([c.object_to_world, rest.expand(len(c.K), meshes - c.object_to_world.shape[1], 4, 4)], dim=1)
                for c in items
            ]
            K, camera_to_world = (torch.cat([getattr(c, name) for c in items]) for name in ("K", "camera_to_world"))
            return Cameras(K, camera_to_world, torch.cat(poses))

        channels = {name: torch.cat([frame.channels[name] for frame in frames]) for name in frames[0].channels}
        gain = torch.cat([frame.gain for frame in frames])
        return Frame(channels, cameras("now"), cameras("previous"), gain, frames[0].source)


def read_frame(
    clip: Clip,
    index: int,
    channels: Iterable[str],
    realisation: int = 0,
    previous: int | None = None,
    window: Window = WHOLE,
) -> Frame:
    """Frame `index` (B = 1) of a clip with the named channels, cut to `window` (slices with start and stop).

    `previous` is the frame that is played before this one, by default the one before it in the clip. Where it is
    another one (reversed playback, a stopped camera), motion vectors are made for it.
    """
    before = max(index - 1, 0)
    previous = before if previous is None else previous
    tensors = {}
    for name in channels:
        if name in CAMERA_CHANNELS:
            continue
        if name in ("motion", "dual_motion") and previous != before:
            array = motion_for_playback(clip, name, index, previous, window)
        else:
            array = clip.read(name, index, window, realisation)
        tensors[name] = to_tensor(array, has_halves=name in REFERENCES)
    return Frame(
        tensors,
        now=Cameras.of(clip.view(index), window),
        previous=Cameras.of(clip.view(previous), window),
        gain=torch.ones(1, 3, 1, 1),
        source=str(clip.path),
    )


def motion_for_playback(clip: Clip, name: str, index: int, previous: int, window: Window) -> np.ndarray:
    """Motion vectors (h, w, 2) to a frame that is not the one before. A camera that stands still hides nothing."""
    if name == "dual_motion" and previous != index:
        raise BadInput(f"{clip.path}: dual motion vectors exist for forward playback only; train without reversing")
    return clip.motion_to(index, previous, window)


def to_tensor(array: np.ndarray, has_halves: bool = False) -> Tensor:
    """(H, W, C) to (1, C, H, W), or (2, H, W, C) to (1, 2, C, H, W); float32."""
    tensor = torch.from_numpy(np.ascontiguousarray(np.moveaxis(array.astype(np.float32), -1, -3)))
    assert tensor.ndim == (4 if has_halves else 3)
    return tensor[None]
