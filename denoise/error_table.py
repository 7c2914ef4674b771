"""error.csv: how far each denoised frame is from the truth, as the halves of its samples tell."""

import csv
import io
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from errors import BadInput
from files import write_file
from models.error_estimate import ErrorEstimate

FILE = "error.csv"


@dataclass(frozen=True)
class FrameError:
    """One row.

    Attributes:
        spp: samples a pixel that the frame has.
        relative_error: root of the mean squared error relative to the light around each pixel.
        at_most: the same, but for chance.
        samples: a pixel, until `at_most` is what was asked for; `spp` where it is, infinite beyond reason.
    """

    frame: int
    spp: float
    relative_error: float
    at_most: float
    samples: float

    @staticmethod
    def of(frame: int, estimate: ErrorEstimate, target: float) -> "FrameError":
        spp = float(estimate.frame.samples.mean())
        return FrameError(
            frame,
            spp,
            estimate.relative_error(),
            estimate.most_relative_error(),
            np.ceil(estimate.samples_for(target)).item(),
        )


def row_of(words: dict[str, str]) -> FrameError:
    """Raises ValueError, KeyError or TypeError for what is no row."""
    return FrameError(int(words.pop("frame")), **{name: float(word) for name, word in words.items()})


class ErrorTable:
    """The rows of a folder's frames, on disk after each. Raises BadInput where the file there is damaged."""

    def __init__(self, folder: Path):
        self.path = folder / FILE
        self.rows: dict[int, FrameError] = {}
        if self.path.exists():
            try:
                with self.path.open(newline="") as file:
                    rows = [row_of(words) for words in csv.DictReader(file)]
            except (TypeError, ValueError, KeyError, AttributeError):
                raise BadInput(f"{self.path} is damaged: delete it and run the command again") from None
            self.rows = {row.frame: row for row in rows}

    def add(self, row: FrameError) -> None:
        self.rows[row.frame] = row
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, [field.name for field in fields(FrameError)])
        writer.writeheader()
        writer.writerows(asdict(self.rows[number]) for number in sorted(self.rows))
        write_file(self.path, text.getvalue().encode())

    def summary(self, target: float) -> str:
        """Which frames are done, and how many samples the others take."""
        waiting = [row.samples for row in self.rows.values() if row.at_most > target]
        done = len(self.rows) - len(waiting)
        text = f"{done} of {len(self.rows)} frames have a relative error of at most {target:g}"
        if waiting:
            text += f"; the others take {min(waiting):g} to {max(waiting):g} samples a pixel"
        return f"{text} ({self.path})"
