"""How hard the clips of a data set are, as a picture."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from plotting import plt, save_figure

BINS = 16
# In the order of datasets.inspect.Difficulty. What lies below the lowest is shown there.
TITLES = (
    "share of black pixels at 1 spp",
    "relative MSE at 1 spp",
    "P99.9 over mean at 1 spp",
    "P95 over P5 of the reference",
)
LOWEST = (1e-3, 1e-2, 1.0, 1.0)


def plot_difficulty(measures: Sequence[Sequence[float]], path: Path) -> None:
    """A PNG with a histogram of each of the four measures (N clips, 4), on logarithmic axes."""
    figure, axes = plt.subplots(1, 4, figsize=(12, 2.6), layout="constrained")
    for axis, title, lowest, values in zip(axes, TITLES, LOWEST, np.array(measures).T, strict=True):
        finite = np.maximum(values[np.isfinite(values)], lowest)
        edges = np.geomspace(lowest, max(finite.max(initial=lowest), 2 * lowest) * 1.0001, BINS + 1)
        axis.hist(finite, edges, color="#4477aa", edgecolor="white")
        axis.set(xscale="log", xlabel=title)
        if len(finite):
            low, middle, high = np.percentile(finite, [5, 50, 95])
            axis.set_title(f"5 %: {low:.2g}   50 %: {middle:.2g}   95 %: {high:.2g}", fontsize=8)
    axes[0].set_ylabel(f"clips of {len(measures)}")
    save_figure(path, figure)
