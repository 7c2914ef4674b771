"""How hard the clips of a data set are, as a picture."""

from collections.abc import Sequence

import numpy as np

from datasets.difficulty import MEASURES, Difficulty
from plotting import Figure, plt

BINS = 16


def difficulty_histograms(clips: Sequence[Difficulty]) -> Figure:
    """A histogram of each measure over all clips, on logarithmic axes. Infinite and undefined values are left out."""
    figure, axes = plt.subplots(1, len(MEASURES), figsize=(12, 2.6), layout="constrained")
    for axis, (field, measure) in zip(axes, MEASURES.items(), strict=True):
        values = np.array([getattr(clip, field) for clip in clips])
        finite = np.maximum(values[np.isfinite(values)], measure.minimum)
        maximum = max(finite.max(initial=measure.minimum), 2 * measure.minimum)
        edges = np.geomspace(measure.minimum, maximum * 1.0001, BINS + 1)
        axis.hist(finite, edges, color="#4477aa", edgecolor="white")
        axis.set(xscale="log", xlabel=measure.title)
        if len(finite):
            low, middle, high = np.percentile(finite, [5, 50, 95])
            axis.set_title(f"5 %: {low:.2g}   50 %: {middle:.2g}   95 %: {high:.2g}", fontsize=8)
    axes[0].set_ylabel(f"clips of {len(clips)}")
    return figure
