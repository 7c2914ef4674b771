"""The pixels of one foreign frame, by quantity, without NaN and infinities."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from denoise.exr_image import ExrImage
from denoise.layers import COLOUR
from denoise.sequence import FrameFiles
from denoise.sources import Sources
from errors import BadInput
from scenes.camera import View

Image = NDArray[np.float32]

MIN_SKY_DEPTH = 1e9  # from here on a pixel is background: Blender writes 1e10
DEPTHS = ("depth", "distance")
MAY_BE_INFINITE = (*DEPTHS, "position")  # at the background


@dataclass
class ForeignFrame:
    """One frame: arrays (H, W, C) in the renderer's conventions, finite, albedo in [0, 1]."""

    arrays: dict[str, Image]  # by quantity, see layers.QUANTITIES
    surface: NDArray[np.bool_]  # where pixels show a surface, (H, W)
    nonfinite: int  # how many pixels were not finite and were set to 0
    source: str  # its name in messages
    header: Mapping[str, Any] = field(default_factory=dict)  # of the file that holds the colour
    view: View | None = None  # its camera, where that is given beside the pixels

    @property
    def size(self) -> tuple[int, int]:
        """(H, W)."""
        height, width = self.surface.shape
        return height, width

    @property
    def has_depth(self) -> bool:
        return any(name in self.arrays for name in DEPTHS)

    def check_depth(self) -> None:
        """Raise BadInput where no depth is positive, as along an axis toward the viewer: all would be background."""
        for name in DEPTHS:
            depth = self.arrays.get(name, np.zeros(0, np.float32))
            near = depth[np.abs(depth) < MIN_SKY_DEPTH]
            if (near < 0).any() and not (near > 0).any():
                raise BadInput(f"{self.source}: the {name} is negative: change its sign, so that it grows away")


def open_passes(files: FrameFiles, header_only: bool = False) -> dict[str, ExrImage]:
    """The files of a frame by pass. Raises BadInput where one is damaged or has another window than the colour."""
    images = {name: ExrImage(path, header_only) for name, path in files.passes.items()}
    colour = images[COLOUR]
    for image in images.values():
        if (image.height, image.width) != (colour.height, colour.width):
            sizes = f"{image.path} is {image.width}x{image.height} and {colour.path} {colour.width}x{colour.height}"
            raise BadInput(f"{sizes}: the passes of a frame must have the same size")
        if image.window != colour.window:
            windows = f"{image.path} begins at {image.window[:2]} and {colour.path} at {colour.window[:2]}"
            raise BadInput(f"{windows}: the passes of a frame must have the same data window")
    return images


def read_foreign_frame(files: FrameFiles, sources: Sources) -> tuple[ForeignFrame, ExrImage]:
    """A frame, and the file that holds its colour. Raises BadInput where a file lacks what the first frame's has."""
    images = open_passes(files)
    arrays = {
        name: images[source.pass_name].stacked(source.layer.channels) for name, source in sources.quantities.items()
    }
    colour = images[COLOUR]
    alpha = colour.stacked([sources.alpha])[..., 0] if sources.alpha else None
    nonfinite = make_finite(arrays)
    return ForeignFrame(arrays, surface_of(arrays, alpha), nonfinite, str(colour.path), colour.header), colour


def make_finite(arrays: dict[str, Image]) -> int:
    """Set pixels that are not finite to 0 and clip the albedo to [0, 1], in place. Returns how many pixels were not."""
    bad = np.zeros(next(iter(arrays.values())).shape[:2], bool)
    for name, array in arrays.items():
        wrong = np.isnan(array) if name in MAY_BE_INFINITE else ~np.isfinite(array)
        if wrong.any():
            there = wrong.any(axis=-1)
            array[there] = 0  # all components: a colour that lacks one has another hue
            bad |= there
    if "albedo" in arrays:
        arrays["albedo"].clip(0, 1, out=arrays["albedo"])
    return int(bad.sum())


def surface_of(arrays: dict[str, Image], alpha: Image | None) -> NDArray[np.bool_]:
    """Surface pixels (H, W): by distances, else positions, else normals and albedo; and by alpha, if any is above 0."""
    ranges = [arrays[name][..., 0] for name in DEPTHS if name in arrays]
    if ranges:
        surface = (ranges[0] > 0) & (ranges[0] < MIN_SKY_DEPTH)
    elif "position" in arrays:
        position = arrays["position"]
        surface = (position != 0).any(axis=-1) & (np.abs(position) < MIN_SKY_DEPTH).all(axis=-1)
    elif "normal" in arrays:
        surface = (arrays["normal"] != 0).any(axis=-1)
        if "albedo" in arrays:
            surface |= (arrays["albedo"] != 0).any(axis=-1)
    else:
        surface = np.ones(arrays[COLOUR].shape[:2], bool)
    return surface & (alpha > 0) if alpha is not None and (alpha > 0).any() else surface
