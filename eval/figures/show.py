"""`onespp show`: the outputs, states and errors of denoisers on a clip."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from datasets.channels import REFERENCE_CHANNELS
from datasets.clip import Clip, is_clip
from datasets.frame import Signal, read_frame, to_tensor
from datasets.tonemap import psnr
from errors import BadInput
from eval.clip_run import as_displayed
from eval.selection import evaluated
from models.denoiser import Denoiser, State
from models.operators import finite
from models.registry import create
from plotting import DPI, TWO_LINE_CAPTION, Figure, enlargement, plt, save_figure

SHOWN_FRAMES = 4  # including the first and the last of the clip
BRIGHTEST_DIFFERENCE = 0.25  # of displayed values; larger ones have the same colour
# The longer side of an image, in pixels.
SMALLEST_IMAGE = 192
LARGEST_IMAGE = 480
COLOUR_BAR = 0.7  # inches beside an image
MOST_IN_A_ROW = 6  # images of one frame


class Panel(NamedTuple):
    """A captioned image: (H, W, 3) in [0, 1], or numbers (H, W), coloured from `low` to `high`."""

    image: NDArray[np.floating]
    caption: str
    low: float = 0.0
    high: float = 1.0


Column = list[Panel]


def in_rows(panels: Sequence[Panel]) -> list[Column]:
    """Columns that show panels row by row, MOST_IN_A_ROW at most in each; white fills the last row."""
    rows = math.ceil(len(panels) / MOST_IN_A_ROW)
    count = math.ceil(len(panels) / rows)
    blank = Panel(np.ones_like(panels[0].image), "")
    filled = [*panels, *[blank] * (rows * count - len(panels))]
    return [filled[column::count] for column in range(count)]


def draw_grid(columns: Sequence[Column], row_names: Sequence[str]) -> Figure:
    """Panels of one size, those of numbers with colour bars; a row name for each panel of a column."""
    height, width = columns[0][0].image.shape[:2]
    zoom = min(LARGEST_IMAGE / max(height, width), enlargement(height, width, SMALLEST_IMAGE)) / DPI
    has_bars = any(column[0].image.ndim == 2 for column in columns)
    size = (
        len(columns) * (width * zoom + COLOUR_BAR * has_bars) + TWO_LINE_CAPTION,
        len(row_names) * (height * zoom + TWO_LINE_CAPTION),
    )
    figure, axes = plt.subplots(
        len(row_names), len(columns), figsize=size, dpi=DPI, squeeze=False, layout="constrained"
    )
    panels = [panel for column in columns for panel in column]
    for axis, panel in zip(axes.T.flat, panels, strict=True):
        drawn = axis.imshow(panel.image, cmap="viridis", vmin=panel.low, vmax=panel.high)
        axis.set(xticks=[], yticks=[])
        axis.set_title(panel.caption, fontsize=8, pad=2)
        if panel.image.ndim == 2:
            figure.colorbar(drawn, ax=axis, fraction=0.05, pad=0.02).ax.tick_params(labelsize=7)
    margin = TWO_LINE_CAPTION / 2 / size[0]
    figure.get_layout_engine().set(rect=(margin, 0, 1 - margin, 1))  # type: ignore
    for axis, name in zip(axes[:, 0], row_names, strict=True):
        axis.set_ylabel(name, fontsize=8)
    return figure


@dataclass
class DenoiserView:
    name: str
    denoiser: Denoiser
    state: State | None = None
    images: Column = field(default_factory=list)  # its output for each shown frame
    differences: Column = field(default_factory=list)  # from the reference; empty where the clip has none
    # of its state after each shown frame, by name: (H, W, 3) in [0, 1], or numbers (H, W)
    pictures: dict[str, list[NDArray[np.floating]]] = field(default_factory=dict)

    def keep(self, output: Tensor, reference: Tensor | None, exposure: float) -> None:
        image = as_displayed(output, exposure)
        signal = self.denoiser.signal
        caption = self.name if signal == "total" else f"{self.name} ({signal})"
        if reference is not None:
            difference = image - as_displayed(reference, exposure)
            mse = float((difference**2).mean())
            caption += f"\nRMSE {mse**0.5:.4f}  {psnr(mse):.2f} dB"
            self.differences.append(Panel(np.abs(difference).mean(axis=2), caption, high=BRIGHTEST_DIFFERENCE))
        self.images.append(Panel(image, caption))
        assert self.state
        for name, picture in self.state.pictures().items():
            in_colour = picture.shape[1] == 3
            shown = as_displayed(picture.float(), exposure) if in_colour else finite(picture)[0, 0].float().numpy()
            self.pictures.setdefault(name, []).append(shown)

    def state_columns(self) -> list[Column]:
        """A column for each picture of the state, with one colour scale for all frames."""
        columns = []
        for name, images in self.pictures.items():
            low, high = float(np.min(images)), float(np.max(images))
            columns.append([Panel(image, name, low, high) for image in images])
        return columns


def runnable(clip: Clip, runs: Path, budget: str, names: Sequence[str]) -> dict[str, Denoiser]:
    """`noisy`, and the named denoisers or all that can run on the clip. Raises BadInput as `evaluated`."""
    specs = evaluated(names, runs, budget, clips=[clip])
    return {"noisy": create("noisy")} | {spec.name: spec.build() for spec in specs}


@torch.inference_mode()
def view_clip(clip: Clip, denoisers: Mapping[str, Denoiser], shown: Sequence[int]) -> tuple[list[DenoiserView], Column]:
    """Run the denoisers over the clip. Returns their views of the `shown` frames, and references if there are any."""
    views = [DenoiserView(name, denoiser) for name, denoiser in denoisers.items()]
    channels = sorted({channel for denoiser in denoisers.values() for channel in denoiser.reads})
    signals: set[Signal] = {"total", *(denoiser.signal for denoiser in denoisers.values())}
    has_reference = all(channel in clip.channels for channel in REFERENCE_CHANNELS)
    references: Column = []
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame", leave=False):
        frame = read_frame(clip, index, channels)
        truth: dict[Signal, Tensor] = {}
        if has_reference and index in shown:
            truth = {signal: to_tensor(clip.reference(index, signal).mean(axis=0)) for signal in signals}
            references.append(Panel(as_displayed(truth["total"], clip.exposure), "reference"))
        for view in views:
            output, view.state = view.denoiser(frame, view.state)
            if index in shown:
                view.keep(output, truth.get(view.denoiser.signal), clip.exposure)
    return views, references


def grids_of(views: Sequence[DenoiserView], references: Column) -> dict[str, list[Column]]:
    grids = {"sheet": [view.images for view in views]}
    if references:
        grids["sheet"].append(references)
        grids["differences"] = [view.differences for view in views]
    return grids | {f"state-{view.name}": view.state_columns() for view in views if view.pictures}


def show(path: Path, out: Path, runs: Path, budget: str, names: Sequence[str] = ()) -> list[Path]:
    """Write PNGs of a clip's denoised frames to the folder `out`; returns their paths.

    `sheet.png`: outputs beside the noisy frames and the reference; `differences.png`: displayed differences from the
    reference; `state-DENOISER.png`: its state. Raises BadInput where there is no clip at `path`, and for named
    denoisers that cannot run.
    """
    if not is_clip(path):
        raise BadInput(f"there is no clip at {path}: name the folder of one, such as data/quick/test/cornell_box/000")
    clip = Clip(path)
    denoisers = runnable(clip, runs, budget, names)
    last = len(clip.judged) - 1
    shown = sorted({clip.judged[round(index)] for index in np.linspace(0, last, SHOWN_FRAMES)})
    out.mkdir(parents=True, exist_ok=True)
    grids = grids_of(*view_clip(clip, denoisers, shown))
    for name, columns in tqdm(grids.items(), "pictures", leave=False):
        save_figure(out / f"{name}.png", draw_grid(columns, [f"frame {index}" for index in shown]))
    return [out / f"{name}.png" for name in grids]
