"""The plots of ablations."""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from eval.ablation.definitions import SINGLE_WINDOWS, WINDOWS_SO_FAR, Ablation
from eval.ablation.variant_run import ABLATION_QUANTITIES, SeedMean, VariantRun, over_seeds
from eval.extra_denoisers import windows_label
from plotting import DPI, plt


def ablation_figure(ablation: Ablation, runs: Sequence[VariantRun], title: str) -> Figure:
    figure = PLOTS[ablation.plot](ablation, runs)
    figure.suptitle(title, fontsize=9)
    return figure


def draw_curves(ablation: Ablation, runs: Sequence[VariantRun]) -> Figure:
    """Training loss by epoch, mean over seeds (RAE Fig. 3)."""
    figure, axis = plt.subplots(figsize=(7, 4.5), dpi=DPI, layout="constrained")
    for variant in ablation.variants:
        losses = np.array([run.losses for run in runs if run.variant == variant.label], float)
        axis.plot(np.arange(1, losses.shape[1] + 1), losses.mean(axis=0), "o-", ms=3, lw=1.2, label=variant.label)
    axis.set(xlabel="epoch", ylabel="training loss", yscale="log")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    return figure


def means_and_spreads(
    runs: Sequence[VariantRun], labels: Sequence[str], metric: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of each label, over seeds; NaN and 0 where there are none."""
    found = [over_seeds(runs, label, metric) or SeedMean(math.nan, None) for label in labels]
    return np.array([one.mean for one in found]), np.array([one.spread or 0.0 for one in found])


def draw_windows(ablation: Ablation, runs: Sequence[VariantRun]) -> Figure:
    """PSNR of windows alone and together (WSKP Fig. 9, 10 left), and time by their number (Fig. 10 right)."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), dpi=DPI, layout="constrained")
    sizes = [window for (window,) in SINGLE_WINDOWS]
    numbers = [len(windows) for windows in WINDOWS_SO_FAR]
    alone = [windows_label(windows) for windows in SINGLE_WINDOWS]
    together = [windows_label(windows) for windows in WINDOWS_SO_FAR]
    for name, labels in (("alone", alone), ("with all smaller ones", together)):
        means, spreads = means_and_spreads(runs, labels, "psnr")
        left.errorbar(sizes, means, spreads, fmt="o-", ms=4, lw=1.2, capsize=3, label=name)
    left.set(xlabel="largest window (px)", ylabel=ABLATION_QUANTITIES["psnr"].title, xticks=sizes)
    left.legend(fontsize=8)
    times, _ = means_and_spreads(runs, together, "fusion_ms")
    right.plot(numbers, times, "o-", ms=4, lw=1.2)
    right.set(xlabel="number of windows", ylabel="construction and fusion (ms)", xticks=numbers, ylim=(0, None))
    for axis in (left, right):
        axis.grid(alpha=0.3)
    return figure


def draw_points(ablation: Ablation, runs: Sequence[VariantRun]) -> Figure:
    """A panel a metric, a point a variant with its spread, and a thin line a seed: variants share seeds.

    No bars: differences are too small to show from zero.
    """
    labels = [variant.label for variant in ablation.variants]
    seeds = sorted({run.seed for run in runs})
    count = len(ablation.metrics)
    figure, axes = plt.subplots(1, count, figsize=(3 * count, 3.6), dpi=DPI, layout="constrained", squeeze=False)
    for axis, metric in zip(axes[0], ablation.metrics, strict=True):
        means, spreads = means_and_spreads(runs, labels, metric)
        axis.errorbar(labels, means, spreads, fmt="o", ms=6, capsize=4)
        for seed in seeds:
            values, _ = means_and_spreads([run for run in runs if run.seed == seed], labels, metric)
            axis.plot(labels, values, color="grey", lw=0.6)
        better = "more" if ABLATION_QUANTITIES[metric].more_is_better else "less"
        axis.set_title(f"{ABLATION_QUANTITIES[metric].title} ({better} is better)", fontsize=8)
        axis.margins(x=0.2, y=0.2)
        axis.tick_params(axis="x", rotation=30, labelsize=8)
        axis.grid(axis="y", alpha=0.3)
    return figure


PLOTS: Mapping[str, Callable[[Ablation, Sequence[VariantRun]], Figure]] = {
    "curves": draw_curves,
    "windows": draw_windows,
    "points": draw_points,
}
