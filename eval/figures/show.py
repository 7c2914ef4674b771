"""`onespp show`: a clip as every denoiser shows it, what each of them carries along, and where it errs."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from datasets.channels import REFERENCES
from datasets.clip import Clip, is_clip
from datasets.frame import Frame, Signal, read_frame
from datasets.tonemap import display, psnr
from errors import BadInput
from eval.selection import evaluated
from models.denoiser import Denoiser, State
from models.operators import finite
from models.registry import create
from plotting import DPI, plt, save_figure

SHOWN = 4  # frames of the clip, the first and the last among them
SMALLEST_PANEL, LARGEST_PANEL = 192, 480  # px, the longer side
CAPTION, BAR = 0.45, 0.7  # inches
LARGEST_DIFFERENCE = 0.25  # as displayed; what is more looks the same

Image = NDArray[np.floating]


class Panel(NamedTuple):
    """A picture with its caption: (H, W, 3) in [0, 1], or numbers (H, W), coloured from `low` to `high`."""

    image: Image
    caption: str
    low: float = 0.0
    high: float = 1.0


Column = list[Panel]  # one panel a shown frame


def save_grid(path: Path, columns: Sequence[Column], row_names: Sequence[str]) -> None:
    """A PNG of panels; those of numbers have colour bars."""
    height, width = columns[0][0].image.shape[:2]
    longer = max(height, width)
    zoom = min(LARGEST_PANEL / longer, max(1, -(-SMALLEST_PANEL // longer))) / DPI
    bars = any(column[0].image.ndim == 2 for column in columns)
    size = (len(columns) * (width * zoom + BAR * bars) + CAPTION, len(row_names) * (height * zoom + CAPTION))
    figure, axes = plt.subplots(
        len(row_names), len(columns), figsize=size, dpi=DPI, squeeze=False, layout="constrained"
    )
    for axis, panel in zip(axes.T.flat, (panel for column in columns for panel in column), strict=True):
        drawn = axis.imshow(panel.image, cmap="viridis", vmin=panel.low, vmax=panel.high)
        axis.set(xticks=[], yticks=[])
        axis.set_title(panel.caption, fontsize=8, pad=2)
        if panel.image.ndim == 2:
            figure.colorbar(drawn, ax=axis, fraction=0.05, pad=0.02).ax.tick_params(labelsize=7)
    figure.get_layout_engine().set(rect=(CAPTION / 2 / size[0], 0, 1 - CAPTION / 2 / size[0], 1))  # type: ignore
    for axis, name in zip(axes[:, 0], row_names, strict=True):
        axis.set_ylabel(name, fontsize=8)
    save_figure(path, figure)


def as_displayed(radiance: Tensor, exposure: float) -> Image:
    """(H, W, 3) in [0, 1] of radiance (1, 3, H, W)."""
    image: Image = display(finite(radiance), exposure)[0].permute(1, 2, 0).numpy()
    return image


def reference_of(frame: Frame, signal: Signal) -> Tensor:
    """Reference radiance (1, 3, H, W) of a signal: the mean of its halves, with emission for "total"."""
    return frame.remodulate(frame.reference_irradiance(signal), signal)


@dataclass
class Track:
    """One denoiser's way through the clip, and what is shown of it: a panel a shown frame."""

    name: str
    denoiser: Denoiser
    state: State | None = None
    images: Column = field(default_factory=list)
    differences: Column = field(default_factory=list)
    pictures: dict[str, list[Image]] = field(default_factory=dict)

    def show(self, output: Tensor, frame: Frame, exposure: float) -> None:
        """Keep the panels of one frame: the image, its difference from the reference if there is one, the state."""
        image, caption = as_displayed(output, exposure), self.name
        if self.denoiser.signal != "total":
            caption += f" ({self.denoiser.signal})"
        if frame.channels.keys() >= set(REFERENCES):
            difference = image - as_displayed(reference_of(frame, self.denoiser.signal), exposure)
            mse = float((difference**2).mean())
            caption += f"\nRMSE {mse**0.5:.4f}  {psnr(mse):.2f} dB"
            self.differences.append(Panel(np.abs(difference).mean(axis=2), caption, high=LARGEST_DIFFERENCE))
        self.images.append(Panel(image, caption))
        assert self.state
        for name, picture in self.state.pictures().items():
            colour = picture.shape[1] == 3
            shown = as_displayed(picture.float(), exposure) if colour else finite(picture)[0, 0].float().numpy()
            self.pictures.setdefault(name, []).append(shown)

    def state_columns(self) -> list[Column]:
        """A column for each of the state's pictures; numbers in the same colours in all frames."""
        low, high = ({name: float(f(images)) for name, images in self.pictures.items()} for f in (np.min, np.max))
        return [[Panel(i, name, low[name], high[name]) for i in images] for name, images in self.pictures.items()]


def runnable(clip: Clip, runs: Path, profile: str, names: Sequence[str]) -> dict[str, Denoiser]:
    """The noisy frame, and the named denoisers or all that have weights and find what they read in the clip.

    Raises BadInput where a named one is unknown, cannot run or has no weights.
    """
    ready = {"noisy": create("noisy")}
    for spec in evaluated(names, runs, profile):
        name = spec.name
        denoiser = spec.build()
        missing = [channel for channel in denoiser.reads if channel not in clip.channels]
        if missing and not names:
            print(f"{name}: skipped, the clip holds no {' and no '.join(missing)}")
            continue
        ready[name] = denoiser
    return ready


@torch.inference_mode()
def play(clip: Clip, denoisers: Mapping[str, Denoiser], shown: Sequence[int]) -> tuple[list[Track], Column]:
    """Run the denoisers over the clip. Returns their tracks, and the shown frames' references if there are any."""
    tracks = [Track(name, denoiser) for name, denoiser in denoisers.items()]
    channels = {channel for denoiser in denoisers.values() for channel in denoiser.reads}
    has_reference = all(channel in clip.channels for channel in REFERENCES)
    references: Column = []
    for index in tqdm(range(clip.frames), f"{clip.scene}/{clip.name}", unit="frame", leave=False):
        wanted = channels | {*REFERENCES, "albedo"} if has_reference and index in shown else channels
        frame = read_frame(clip, index, sorted(wanted))
        for track in tracks:
            output, track.state = track.denoiser(frame, track.state)
            if index in shown:
                track.show(output, frame, clip.exposure)
        if has_reference and index in shown:
            references.append(Panel(as_displayed(reference_of(frame, "total"), clip.exposure), "reference"))
    return tracks, references


def show(path: Path, out: Path, runs: Path, profile: str, names: Sequence[str] = ()) -> list[Path]:
    """Write PNGs of a clip's denoised frames to the folder `out`; returns their paths.

    `sheet.png`: columns of denoisers between the noisy frames and the reference; `differences.png`: where each is off
    the reference as displayed, in colours up to 0.25; `state-DENOISER.png`: what it carries from frame to frame.
    Raises BadInput where there is no clip at `path`, and for denoisers that are named but cannot run.
    """
    if not is_clip(path):
        raise BadInput(f"there is no clip at {path}: name the folder of one, such as data/quick/test/cornell_box/000")
    clip = Clip(path)
    denoisers = runnable(clip, runs, profile, names)
    shown = sorted({round(index) for index in np.linspace(0, clip.frames - 1, SHOWN)})
    out.mkdir(parents=True, exist_ok=True)
    tracks, references = play(clip, denoisers, shown)

    grids = {"sheet": [*(track.images for track in tracks), *([references] if references else [])]}
    if references:
        grids["differences"] = [track.differences for track in tracks]
    grids |= {f"state-{track.name}": track.state_columns() for track in tracks if track.pictures}
    for name, columns in tqdm(grids.items(), "pictures", leave=False):
        save_grid(out / f"{name}.png", columns, [f"frame {index}" for index in shown])
    return [out / f"{name}.png" for name in grids]
