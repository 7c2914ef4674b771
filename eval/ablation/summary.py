"""What came out of an ablation: numbers over seeds, the table beside the paper's findings, and the plot."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tabulate import tabulate

from eval.ablation.definitions import CUMULATIVE, SINGLE, Ablation, Finding, label_of
from eval.metrics import METRICS, Quantity
from plotting import DPI, plt

MEASURED = METRICS | {
    "train_loss": Quantity("training loss", "{:.4f}"),  # of the last epoch
    "fusion_ms": Quantity("fusion ms", "{:.3f}"),
}


@dataclass
class Run:
    """One variant, trained with one seed and judged."""

    variant: str
    seed: int
    parameters: int
    losses: list[float | None]  # mean training loss of each epoch; None where it never was finite
    clips: dict[str, dict[str, float | None]]  # means of metrics on each test clip
    fusion_ms: float | None = None  # median of a frame

    def value(self, metric: str) -> float | None:
        """A metric's mean over the clips where it is defined, the last epoch's loss, or the time."""
        if metric == "train_loss":
            return self.losses[-1]
        if metric == "fusion_ms":
            return self.fusion_ms
        values = [value for means in self.clips.values() if (value := means[metric]) is not None]
        return float(np.mean(values)) if values else None


def over_seeds(runs: Sequence[Run], label: str, metric: str) -> tuple[float, float | None] | None:
    """Mean and, of several, standard deviation of a variant's runs; None where the metric is not defined."""
    values = [value for run in runs if run.variant == label and (value := run.value(metric)) is not None]
    if not values:
        return None
    return float(np.mean(values)), float(np.std(values, ddof=1)) if values[1:] else None


def cell(runs: Sequence[Run], label: str, metric: str) -> str:
    found, form = over_seeds(runs, label, metric), MEASURED[metric].form
    if found is None:
        return "-"
    mean, spread = found
    return form.format(mean) + (f" ± {form.format(spread)}" if spread is not None else "")


def holds(finding: Finding, pair: tuple[str, str], runs: Sequence[Run]) -> bool:
    """Whether the first of a pair is better than the second, in the mean of `runs`."""
    sign = 1 if MEASURED[finding.metric].more_is_better else -1
    better, worse = (over_seeds(runs, label, finding.metric) for label in pair)
    return better is not None and worse is not None and sign * better[0] > sign * worse[0]


def verdict(finding: Finding, runs: Sequence[Run]) -> str:
    """Whether the paper's order holds in the means over seeds, where it does not, and in how many seeds it does."""
    if any(over_seeds(runs, label, finding.metric) is None for pair in finding.pairs for label in pair):
        return "not defined on these clips"
    against = [pair for pair in finding.pairs if not holds(finding, pair, runs)]
    text = f"does not hold in {len(against)} of {len(finding.pairs)}: " if against else "holds"
    values = [[f"{label} {cell(runs, label, finding.metric)}" for label in pair] for pair in against]
    text += "; ".join(" is no better than ".join(pair) for pair in values)
    by_seed = [[run for run in runs if run.seed == seed] for seed in sorted({run.seed for run in runs})]
    agree = sum(all(holds(finding, pair, alone) for pair in finding.pairs) for alone in by_seed)
    return text + (f" (seed by seed: in {agree} of {len(by_seed)})" if by_seed[1:] else "")


def verdicts(ablation: Ablation, runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Each finding with its verdict, in the form of results.json."""
    return [vars(finding) | {"here": verdict(finding, runs)} for finding in ablation.findings]


def report(ablation: Ablation, runs: Sequence[Run], form: str = "simple") -> str:
    """A row a variant beside the paper's number, and below them the findings. `form` is one of tabulate's."""
    sizes = {run.variant: run.parameters for run in runs}
    lines = [
        [v.label, f"{sizes[v.label]:,}", *(cell(runs, v.label, metric) for metric in ablation.metrics), v.paper]
        for v in ablation.variants
    ]
    head = ["variant", "parameters", *(MEASURED[metric].title for metric in ablation.metrics), "paper, its scenes"]
    found = [f"- {f['text']} (by {MEASURED[f['metric']].title}): {f['here']}" for f in verdicts(ablation, runs)]
    return "\n".join([tabulate(lines, head, form, disable_numparse=True), "\nWhat the paper found, here:\n", *found])


def draw(ablation: Ablation, runs: Sequence[Run], title: str) -> Figure:
    figure = PLOTS[ablation.plot](ablation, runs)
    figure.suptitle(title, fontsize=9)
    return figure


def draw_curves(ablation: Ablation, runs: Sequence[Run]) -> Figure:
    """Training loss by epoch, mean over seeds (RAE Fig. 3)."""
    figure, axis = plt.subplots(figsize=(7, 4.5), dpi=DPI, layout="constrained")
    for variant in ablation.variants:
        losses = np.array([run.losses for run in runs if run.variant == variant.label], float)
        axis.plot(np.arange(1, losses.shape[1] + 1), losses.mean(axis=0), "o-", ms=3, lw=1.2, label=variant.label)
    axis.set(xlabel="epoch", ylabel="training loss", yscale="log")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)
    return figure


def points(runs: Sequence[Run], labels: Sequence[str], metric: str) -> tuple[np.ndarray, np.ndarray]:
    """Means and spreads over seeds, NaN and 0 where there are none."""
    found = [over_seeds(runs, label, metric) or (math.nan, None) for label in labels]
    return np.array([mean for mean, _ in found]), np.array([spread or 0.0 for _, spread in found])


def draw_windows(ablation: Ablation, runs: Sequence[Run]) -> Figure:
    """PSNR of windows alone and together (WSKP Fig. 9, 10 left), and time by their number (Fig. 10 right)."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), dpi=DPI, layout="constrained")
    sizes, numbers = [window for (window,) in SINGLE], [len(windows) for windows in CUMULATIVE]
    together = [label_of(windows) for windows in CUMULATIVE]
    for name, labels in (("alone", [label_of(windows) for windows in SINGLE]), ("with all smaller ones", together)):
        means, spreads = points(runs, labels, "psnr")
        left.errorbar(sizes, means, spreads, fmt="o-", ms=4, lw=1.2, capsize=3, label=name)
    left.set(xlabel="largest window (px)", ylabel=MEASURED["psnr"].title, xticks=sizes)
    left.legend(fontsize=8)
    right.plot(numbers, points(runs, together, "fusion_ms")[0], "o-", ms=4, lw=1.2)
    right.set(xlabel="number of windows", ylabel="construction and fusion (ms)", xticks=numbers, ylim=(0, None))
    for axis in (left, right):
        axis.grid(alpha=0.3)
    return figure


def draw_points(ablation: Ablation, runs: Sequence[Run]) -> Figure:
    """A panel a metric, a point a variant with its spread, and a thin line a seed: variants share seeds.

    No bars: differences are too small to show from zero.
    """
    seeds = sorted({run.seed for run in runs})
    count, labels = len(ablation.metrics), [variant.label for variant in ablation.variants]
    figure, axes = plt.subplots(1, count, figsize=(3 * count, 3.6), dpi=DPI, layout="constrained", squeeze=False)
    for axis, metric in zip(axes[0], ablation.metrics, strict=True):
        axis.errorbar(labels, *points(runs, labels, metric), fmt="o", ms=6, capsize=4)
        for seed in seeds:
            alone = [run for run in runs if run.seed == seed]
            axis.plot(labels, points(alone, labels, metric)[0], color="grey", lw=0.6)
        better = "more" if MEASURED[metric].more_is_better else "less"
        axis.set_title(f"{MEASURED[metric].title} ({better} is better)", fontsize=8)
        axis.margins(x=0.2, y=0.2)
        axis.tick_params(axis="x", rotation=30, labelsize=8)
        axis.grid(axis="y", alpha=0.3)
    return figure


PLOTS: Mapping[str, Callable[[Ablation, Sequence[Run]], Figure]] = {
    "curves": draw_curves,
    "windows": draw_windows,
    "points": draw_points,
}
