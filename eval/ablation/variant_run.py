"""What was measured of a variant: numbers of one training, and their means over seeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from eval.metrics import METRICS, Quantity, Values

ABLATION_QUANTITIES = METRICS | {
    "train_loss": Quantity("training loss", "{:.4f}"),  # of the last epoch
    "fusion_ms": Quantity("fusion ms", "{:.3f}"),
}


@dataclass(frozen=True)
class VariantRun:
    """One variant, trained with one seed and judged: a row of results.json.

    Attributes:
        variant: its label.
        losses: mean training loss of each epoch; None where it never was finite.
        clips: means of metrics on each test clip.
        fusion_ms: median of a frame; None where the ablation is not timed.
    """

    variant: str
    seed: int
    parameters: int
    losses: list[float | None]
    clips: dict[str, Values]
    fusion_ms: float | None = None

    def value(self, metric: str) -> float | None:
        """A metric's mean over the clips where it is defined, the last epoch's loss, or the time."""
        if metric == "train_loss":
            return self.losses[-1]
        if metric == "fusion_ms":
            return self.fusion_ms
        values = [value for means in self.clips.values() if (value := means[metric]) is not None]
        return float(np.mean(values)) if values else None


class SeedMean(NamedTuple):
    """Mean over seeds and, of several, their standard deviation."""

    mean: float
    spread: float | None


def over_seeds(runs: Sequence[VariantRun], label: str, metric: str) -> SeedMean | None:
    """Of the runs of one variant; None where the metric is not defined."""
    values = [value for run in runs if run.variant == label and (value := run.value(metric)) is not None]
    if not values:
        return None
    return SeedMean(float(np.mean(values)), float(np.std(values, ddof=1)) if len(values) > 1 else None)
