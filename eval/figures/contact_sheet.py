"""A contact sheet of scenes, to look at before rendering hours of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.tonemap import clip_exposure, display, luminance
from plotting import DPI, ONE_LINE_CAPTION, plt, save_figure
from render.shot import Shot
from render.stage import Stage
from scenes.registry import build_scene


def frame_of(name: str, seed: int, frame: int, frames: int, height: int, width: int, spp: int) -> NDArray[np.float64]:
    """One of the `frames` of a scene as displayed with an exposure of its own, (H, W, 3) in [0, 1]."""
    shot = Shot(Stage(build_scene(name, seed, frames), height, width), frame)
    reflected = shot.reflected(seed, spp)
    return display(reflected + shot.emission, clip_exposure(luminance(reflected)))


def contact_sheet(
    path: Path, names: Sequence[str], seed: int = 0, frames: int = 24, size: tuple[int, int] = (192, 256), spp: int = 64
) -> None:
    """Write a PNG with the middle frame of each scene in `names`, `size` = (height, width) each.

    Raises BadInput for an unknown scene.
    """
    height, width = size
    columns = int(np.ceil(np.sqrt(len(names))))
    rows = -(-len(names) // columns)
    sheet = (columns * width / DPI, rows * (height / DPI + ONE_LINE_CAPTION))
    figure, axes = plt.subplots(rows, columns, figsize=sheet, dpi=DPI, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, name in zip(axes.flat, tqdm(names, "scenes", unit="scene"), strict=False):
        axis.imshow(frame_of(name, seed, frames // 2, frames, height, width, spp), interpolation="nearest")
        axis.set_title(name, fontsize=8, pad=2)
    top = 1 - ONE_LINE_CAPTION / sheet[1]
    figure.subplots_adjust(left=0, right=1, bottom=0, top=top, wspace=0.01, hspace=ONE_LINE_CAPTION * DPI / height)
    save_figure(path, figure)
