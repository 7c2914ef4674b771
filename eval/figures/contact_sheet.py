"""A contact sheet of scenes."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.tonemap import clip_exposure, display, luminance
from errors import BadInput
from plotting import DPI, plt, save_figure
from render.path import PosedFrame
from render.scene_file.load import own_scene
from render.stage import Stage
from scenes.registry import build_scene

FLIGHT_FRAMES = 24  # of each flight, of which the middle one is shown
TITLE_INCHES = 0.2  # height of the line above each picture


def displayed_frame(
    name: str, seed: int, frame: int, frames: int, height: int, width: int, spp: int, models: Path | None = None
) -> NDArray[np.float64]:
    """One frame of a scene as displayed, (H, W, 3) in [0, 1], with an exposure of its own.

    `name` is that of a built-in scene, which may need `models` (see build_scene), or the path of a TOML. Raises
    BadInput for an unknown scene.
    """
    if name.endswith(".toml"):
        described = own_scene(Path(name))
        for note in described.notes:
            tqdm.write(note)
        scene = described.clip("test", 0, frames, seed)
    else:
        scene = build_scene(name, seed, frames, models)
    posed = PosedFrame(Stage(scene, height, width), frame)
    reflected = posed.reflected(seed, spp)
    return display(reflected + posed.emission, clip_exposure(luminance(reflected)))


def contact_sheet(
    path: Path,
    names: Sequence[str],
    seed: int = 0,
    size: tuple[int, int] = (192, 256),
    spp: int = 64,
    models: Path | None = None,
) -> None:
    """Write a PNG of the scenes' middle frames in `size` (height, width).

    Raises BadInput for an unknown scene, a negative seed, and less than one sample per pixel.
    """
    if seed < 0 or spp < 1:
        raise BadInput(f"seed {seed}, {spp} spp: use a seed of 0 or more, and at least one sample per pixel")
    height, width = size
    columns = math.ceil(math.sqrt(len(names)))
    rows = math.ceil(len(names) / columns)
    sheet_width = columns * width / DPI
    sheet_height = rows * (height / DPI + TITLE_INCHES)
    figure, axes = plt.subplots(rows, columns, figsize=(sheet_width, sheet_height), dpi=DPI, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, name in zip(axes.flat, tqdm(names, "scenes", unit="scene"), strict=False):
        image = displayed_frame(name, seed, FLIGHT_FRAMES // 2, FLIGHT_FRAMES, height, width, spp, models)
        axis.imshow(image, interpolation="nearest")
        axis.set_title(name, fontsize=8, pad=2)
    figure.subplots_adjust(
        left=0, right=1, bottom=0, top=1 - TITLE_INCHES / sheet_height, wspace=0.01, hspace=TITLE_INCHES * DPI / height
    )
    save_figure(path, figure)
