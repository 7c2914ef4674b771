"""Results of stress checks, as results.json contains them."""

from dataclasses import asdict, dataclass
from typing import Any

FRESH = "fresh"  # instead of a file: random weights


@dataclass(frozen=True)
class StressOutcome:
    """The result of a denoiser in a stress case.

    Attributes:
        error: the largest, relative to the brightest expected pixel, absolute if that is black; None where no pixel is
            finite.
        nonfinite: output pixels that are not finite, in all frames.
        violation: largest distance from the range, relative to its end (convex filters), or below 0 (others).
        recovery: frames until the effect of a bad pixel ends, 0 if it has none; None if it does not end, and in cases
            without a bad pixel.
        broken: the requirements that are not kept, keys of REQUIREMENTS.
    """

    error: float | None
    nonfinite: int
    violation: float
    recovery: int | None
    broken: tuple[str, ...]


@dataclass(frozen=True)
class StressRow:
    """A row of results.json. `weights` is a file, FRESH, or None for a denoiser without; `extreme` the case's name."""

    denoiser: str
    weights: str | None
    extreme: str
    outcome: StressOutcome

    def as_json(self) -> dict[str, Any]:
        names = {"denoiser": self.denoiser, "weights": self.weights, "extreme": self.extreme}
        return names | asdict(self.outcome)
