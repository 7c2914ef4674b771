"""How far denoised frames are from the truth: measured by references (metrics.csv), or estimated (error.csv)."""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray
from tabulate import tabulate

from datasets.frame import to_tensor
from denoise.exr_image import ExrImage
from denoise.layers import COLOUR
from denoise.sequence import FrameFiles
from denoise.sources import find_sources
from errors import BadInput
from eval.comparison import Comparison
from eval.metrics import METRICS
from files import write_csv
from models.wrappers.error_estimate import ErrorEstimate

METRICS_FILE = "metrics.csv"
ERRORS_FILE = "error.csv"
COMPARED_METRICS = ("rmse", "psnr", "ssim")


def compare(
    frames: Sequence[FrameFiles], references: Sequence[Path], out: Path, target: Sequence[str], exposure: float
) -> str:
    """Measure the `target` channels of frames on disk against references, as displayed, and write metrics.csv.

    Returns a table of the means. Raises BadInput where a reference is of another size.
    """
    rows = []
    for files, reference in zip(frames, references, strict=True):
        reference_pair = to_tensor(radiance(reference, target)).repeat(2, 1, 1, 1)
        denoised = to_tensor(radiance(out / files.name, target))
        if reference_pair.shape[1:] != denoised.shape[1:]:
            raise BadInput(f"{reference} is of another size than {out / files.name}")
        comparison = Comparison(denoised, reference_pair, exposure, one_reference=True)
        rows.append([files.number, *(METRICS[name].of(comparison) for name in COMPARED_METRICS)])
    write_csv(out / METRICS_FILE, ["frame", *COMPARED_METRICS], rows)
    columns = zip(COMPARED_METRICS, list(zip(*rows, strict=True))[1:], strict=True)
    cells = ["-" if None in column else METRICS[name].form.format(np.mean(column)) for name, column in columns]
    return tabulate([cells], [f"mean {METRICS[name].title}" for name in COMPARED_METRICS], disable_numparse=True)


def radiance(path: Path, target: Sequence[str]) -> NDArray[np.float32]:
    """The radiance (H, W, 3) of a finished image, finite: its `target` channels, or else those called like radiance."""
    image = ExrImage(path)
    channels = target if all(name in image.channels for name in target) else find_sources({COLOUR: image}, {}).target
    return np.nan_to_num(image.stacked(channels), nan=0.0, posinf=0.0, neginf=0.0)


@dataclass(frozen=True)
class FrameError:
    frame: int
    spp: float  # samples per pixel of the frame
    relative_error: float  # root of the mean squared error relative to the mean light of each pixel's neighbourhood
    at_most: float  # the same with two standard errors added
    until: float | None  # the relative error to reach; None where none was given
    samples: float | None  # per pixel, to reach it; `spp` where it is reached, infinite beyond a limit

    @staticmethod
    def of(frame: int, estimate: ErrorEstimate, until: float | None) -> "FrameError":
        spp = float(estimate.frame.samples.mean())
        samples = None if until is None else np.ceil(estimate.samples_for(until)).item()
        return FrameError(frame, spp, estimate.relative_error(), estimate.max_relative_error(), until, samples)


class ErrorTable:
    """The rows of a folder's frames, written after each. Raises BadInput where the file there is damaged."""

    def __init__(self, folder: Path):
        self.path = folder / ERRORS_FILE
        self.rows: dict[int, FrameError] = {}
        if self.path.exists():
            try:
                with self.path.open(newline="") as file:
                    cells = [{name: cell or None for name, cell in row.items()} for row in csv.DictReader(file)]
                rows = msgspec.convert(cells, list[FrameError], strict=False)
            except (msgspec.ValidationError, ValueError, csv.Error):
                raise BadInput(f"{self.path} is damaged: delete it and run the command again") from None
            self.rows = {row.frame: row for row in rows}

    def add(self, row: FrameError) -> None:
        self.rows[row.frame] = row
        rows = (astuple(self.rows[number]) for number in sorted(self.rows))
        write_csv(self.path, [field.name for field in fields(FrameError)], rows)

    def has(self, frame: int, until: float | None) -> bool:
        return frame in self.rows and self.rows[frame].until == until

    def summary(self, frames: Iterable[int]) -> str:
        """How many of the frames have reached the relative error, and how many samples the others need."""
        rows = [self.rows[frame] for frame in frames]
        waiting = [row.samples for row in rows if row.samples and row.samples > row.spp]
        text = f"{len(rows) - len(waiting)} of {len(rows)} frames have a relative error of at most {rows[0].until:g}"
        if waiting:
            text += f"; the others need {min(waiting):g} to {max(waiting):g} samples per pixel"
        return f"{text} ({self.path})"
