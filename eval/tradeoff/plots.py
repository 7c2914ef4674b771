"""The plots of the trade: quality against milliseconds, and against samples a pixel."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from eval.metrics import METRICS
from plotting import DPI, plt

MARKERS = {"float32": "o", "bfloat16": "s", "float16": "^"}

Row = Mapping[str, Any]


def plain_ticks(axis: Axes) -> None:
    """Milliseconds as 2, 5, 10, 20 instead of powers."""
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def signals_of(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(row["signal"] for row in rows))


def draw_front(rows: Sequence[Row], metric: str, title: str) -> Figure:
    """A metric against milliseconds, a panel a signal: the front as a line, what it dominates hollow."""
    signals = signals_of(rows)
    figure, axes = plt.subplots(
        *(len(signals), 1), figsize=(9, 5.5 * len(signals)), dpi=DPI, layout="constrained", squeeze=False
    )
    for axis, signal in zip(axes[:, 0], signals, strict=True):
        shown = [r for r in rows if r["signal"] == signal and r["ms"] is not None and r["metrics"][metric] is not None]
        draw_panel(axis, shown, metric)
        axis.set_title(f"{signal} light", fontsize=9)
    figure.suptitle(title, fontsize=9)
    return figure


def draw_panel(axis: Axes, rows: Sequence[Row], metric: str) -> None:
    front = sorted((row for row in rows if row["dominated_by"][metric] is None), key=lambda row: row["ms"])
    # What a budget of milliseconds buys at best: it rises where the next one of the front can be afforded.
    axis.step([r["ms"] for r in front], [r["metrics"][metric] for r in front], where="post", lw=1, color="C0")
    for row in rows:
        on_front = row["dominated_by"][metric] is None
        fill, edge = ("C0", "C0") if on_front else ("none", "grey")
        axis.plot(row["ms"], row["metrics"][metric], MARKERS[row["dtype"]], ls="", ms=6, mfc=fill, mec=edge)
        axis.annotate(
            row["denoiser"],
            (row["ms"], row["metrics"][metric]),
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=8 if on_front else 6,
            color="black" if on_front else "grey",
        )
    for dtype in dict.fromkeys(row["dtype"] for row in rows):
        axis.plot([], [], MARKERS[dtype], color="grey", mfc="none", label=dtype)
    better = "more" if METRICS[metric].more_is_better else "less"
    axis.set(xlabel="ms a frame", ylabel=f"{METRICS[metric].title} ({better} is better)")
    plain_ticks(axis)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)


def draw_samples(rows: Sequence[Row], title: str) -> Figure:
    """PSNR against samples a pixel, and against milliseconds of rendering and filtering together; a row a signal."""
    signals = signals_of(rows)
    figure, axes = plt.subplots(
        *(len(signals), 2), figsize=(11, 4.5 * len(signals)), dpi=DPI, layout="constrained", squeeze=False
    )
    for (left, right), signal in zip(axes, signals, strict=True):
        ours = [row for row in rows if row["signal"] == signal]
        for label in dict.fromkeys(row["label"] for row in ours):
            line = [row for row in ours if row["label"] == label]
            psnr = [row["metrics"]["psnr"] for row in line]
            (drawn,) = left.plot([row["spp"] for row in line], psnr, "o-", ms=4, lw=1.2, label=label)
            if all(row["ms"] is not None for row in line):
                right.plot([row["ms"] for row in line], psnr, "o-", ms=4, lw=1.2, color=drawn.get_color())
        left.set_xscale("log", base=2)
        left.set(xlabel="samples a pixel", ylabel=f"{METRICS['psnr'].title}, {signal} light")
        left.set_xticks(levels := sorted({row["spp"] for row in ours}), map(str, levels))
        right.set(xlabel="ms a frame, rendering and filter")
        plain_ticks(right)
        left.legend(fontsize=8)
        for axis in (left, right):
            axis.grid(alpha=0.3, which="both")
    figure.suptitle(title, fontsize=9)
    return figure
