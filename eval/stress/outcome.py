"""What a stress check finds, and the form in which results.json keeps it."""

from dataclasses import asdict, dataclass
from typing import Any

FRESH = "fresh"  # stands for the file of weights that are not trained


@dataclass(frozen=True)
class StressOutcome:
    """What came of a denoiser in a stress case.

    Attributes:
        error: the largest, over the brightest pixel of what the output is compared with, absolute where that is black;
            None where no pixel is finite.
        nonfinite: output pixels, of all frames.
        violation: how far the output leaves its range, over the range's end (convex filters), or below 0 (others).
        recovery: frames until a bad pixel is forgotten, 0 where nothing shows it; None where that never happens, and
            in cases without one.
        broken: the requirements that are not kept, keys of REQUIREMENTS.
    """

    error: float | None
    nonfinite: int
    violation: float
    recovery: int | None
    broken: tuple[str, ...]


@dataclass(frozen=True)
class StressRow:
    """A row of results.json, which holds the outcome's attributes beside these.

    `weights` is their file, or FRESH; None for a denoiser that has none. `extreme` is the case's name.
    """

    denoiser: str
    weights: str | None
    extreme: str
    outcome: StressOutcome

    def as_json(self) -> dict[str, Any]:
        names = {"denoiser": self.denoiser, "weights": self.weights, "extreme": self.extreme}
        return names | asdict(self.outcome)
