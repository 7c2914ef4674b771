"""How hard the clips of a data set are, as a picture."""

from pathlib import Path

import numpy as np
from tqdm import tqdm

from datasets.clip import Clip, Dataset, is_clip
from datasets.figure import plt, save_figure
from datasets.inspect import difficulty
from errors import BadInput

BINS = 16
# In the order of Difficulty. What lies below the lowest is shown there.
TITLES = (
    "share of black pixels at 1 spp",
    "relative MSE at 1 spp",
    "P99.9 over mean at 1 spp",
    "P95 over P5 of the reference",
)
LOWEST = (1e-3, 1e-2, 1.0, 1.0)


def plot_difficulty(root: Path, path: Path) -> None:
    """A PNG with a histogram of each measure over all clips that are there, on logarithmic axes.

    Raises BadInput where none is.
    """
    paths = [clip for clip in Dataset(root).planned() if is_clip(clip)]
    if not paths:
        raise BadInput(f"{root} has no clips yet: render some with `onespp dataset`")
    measures = np.array([difficulty(Clip(clip)) for clip in tqdm(paths, "difficulty", unit="clip", leave=False)])
    figure, axes = plt.subplots(1, 4, figsize=(12, 2.6), layout="constrained")
    for axis, title, lowest, values in zip(axes, TITLES, LOWEST, measures.T, strict=True):
        finite = np.maximum(values[np.isfinite(values)], lowest)
        edges = np.geomspace(lowest, max(finite.max(initial=lowest), 2 * lowest) * 1.0001, BINS + 1)
        axis.hist(finite, edges, color="#4477aa", edgecolor="white")
        axis.set(xscale="log", xlabel=title)
        if len(finite):
            low, middle, high = np.percentile(finite, [5, 50, 95])
            axis.set_title(f"5 %: {low:.2g}   50 %: {middle:.2g}   95 %: {high:.2g}", fontsize=8)
    axes[0].set_ylabel(f"clips of {len(paths)}")
    save_figure(path, figure)
