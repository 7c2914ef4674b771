"""Plots of quality against milliseconds, and against samples per pixel."""

from collections.abc import Sequence

from eval.metrics import METRICS
from eval.tradeoff.pareto import Point
from eval.tradeoff.trades import Trade
from plotting import DPI, Axes, Figure, plt, ticker

MARKERS = {"float32": "o", "bfloat16": "s", "float16": "^"}


def plain_ticks(axis: Axes) -> None:
    """Milliseconds on a logarithmic axis, as 2, 5, 10, 20 instead of powers."""
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
    axis.xaxis.set_minor_formatter(ticker.NullFormatter())


def draw_front(rows: Sequence[Trade], metric: str, title: str) -> Figure:
    """A metric against milliseconds, one panel per signal: the front as a line, dominated points hollow."""
    signals = list(dict.fromkeys(row.signal for row in rows))
    size = (9, 5.5 * len(signals))
    figure, axes = plt.subplots(len(signals), 1, figsize=size, dpi=DPI, layout="constrained", squeeze=False)
    for axis, signal in zip(axes[:, 0], signals, strict=True):
        drawn = [(row, point) for row in rows if row.signal == signal and (point := row.point(metric))]
        draw_panel(axis, drawn, metric)
        axis.set_title(f"{signal} light", fontsize=9)
    figure.suptitle(title, fontsize=9)
    return figure


def draw_panel(axis: Axes, rows: Sequence[tuple[Trade, Point]], metric: str) -> None:
    """The rows of one signal and their front."""
    front = sorted((point for row, point in rows if row.dominated_by[metric] is None), key=lambda point: point.ms)
    # The best quality within a number of milliseconds: steps at the points of the front.
    axis.step([point.ms for point in front], [point.quality for point in front], where="post", lw=1, color="C0")
    for row, point in rows:
        on_front = row.dominated_by[metric] is None
        axis.plot(
            point.ms,
            point.quality,
            MARKERS[row.dtype],
            ls="",
            ms=6,
            mfc="C0" if on_front else "none",
            mec="C0" if on_front else "grey",
        )
        axis.annotate(
            row.denoiser,
            point,
            xytext=(4, 4),
            textcoords="offset points",
            fontsize=8 if on_front else 6,
            color="black" if on_front else "grey",
        )
    for dtype in dict.fromkeys(row.dtype for row, _ in rows):
        axis.plot([], [], MARKERS[dtype], color="grey", mfc="none", label=dtype)
    better = "more" if METRICS[metric].more_is_better else "less"
    axis.set(xlabel="ms a frame", ylabel=f"{METRICS[metric].title} ({better} is better)")
    plain_ticks(axis)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8)


def draw_samples(rows: Sequence[Trade], title: str) -> Figure:
    """PSNR against samples per pixel, and against milliseconds of rendering and filtering; one row per signal."""
    signals = list(dict.fromkeys(row.signal for row in rows))
    size = (11, 4.5 * len(signals))
    figure, axes = plt.subplots(len(signals), 2, figsize=size, dpi=DPI, layout="constrained", squeeze=False)
    for (left, right), signal in zip(axes, signals, strict=True):
        ours = [row for row in rows if row.signal == signal]
        for label in dict.fromkeys(row.label for row in ours):
            line = [row for row in ours if row.label == label]
            psnr = [row.metrics["psnr"] for row in line]
            (drawn,) = left.plot([row.spp for row in line], psnr, "o-", ms=4, lw=1.2, label=label)
            if all(row.ms is not None for row in line):
                right.plot([row.ms for row in line], psnr, "o-", ms=4, lw=1.2, color=drawn.get_color())
        left.set_xscale("log", base=2)
        left.set(xlabel="samples a pixel", ylabel=f"{METRICS['psnr'].title}, {signal} light")
        levels = sorted({row.spp for row in ours})
        left.set_xticks(levels, map(str, levels))
        right.set(xlabel="ms a frame, rendering and filter")
        plain_ticks(right)
        left.legend(fontsize=8)
        for axis in (left, right):
            axis.grid(alpha=0.3, which="both")
    figure.suptitle(title, fontsize=9)
    return figure
