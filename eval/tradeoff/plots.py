"""Plots of quality against samples per pixel, and against milliseconds of rendering and filtering."""

from collections.abc import Sequence

from eval.metrics import METRICS
from eval.tradeoff.trades import Trade
from plotting import DPI, Axes, Figure, plt, ticker


def plain_ticks(axis: Axes) -> None:
    """Milliseconds on a logarithmic axis, as 2, 5, 10, 20 instead of powers."""
    axis.set_xscale("log")
    axis.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
    axis.xaxis.set_minor_formatter(ticker.NullFormatter())


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
