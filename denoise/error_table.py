"""error.csv: the estimated error of each denoised frame."""

import csv
from collections.abc import Iterable
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import msgspec
import numpy as np

from errors import BadInput
from files import write_csv
from models.wrappers.error_estimate import ErrorEstimate


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
        self.path = folder / "error.csv"
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
