"""The report's plots of quality against time."""

from collections.abc import Sequence
from dataclasses import dataclass

from eval.means import scores_of
from eval.results import ClipResults, by_signal, of_one_spp
from eval.tradeoff.pareto import Point, dominated_by_name
from eval.tradeoff.times import Times
from models.spec import DenoiserSpec

PLOTTED = ("flip", "rmse", "ssim", "psnr", "temporal_error")  # the page opens with the first


@dataclass(frozen=True)
class PlotPoint:
    """Milliseconds per frame, the mean of a metric, and the denoiser that dominates it; None on the Pareto front."""

    name: str
    ms: float
    quality: float
    by: str | None


@dataclass(frozen=True)
class TradePlot:
    """Points of one signal and metric, fastest first; `missing` are the denoisers without a time or value."""

    signal: str
    metric: str
    points: list[PlotPoint]
    missing: list[str]
    size: str


def trade_plots(times: Times, clips: Sequence[ClipResults]) -> list[TradePlot]:
    """A plot for each signal and metric, over the clips of 1 spp, without empty ones."""
    plots = [trade_plot(times, ours, metric) for ours in by_signal(of_one_spp(clips)).values() for metric in PLOTTED]
    return [plot for plot in plots if plot.points]


def trade_plot(times: Times, clips: Sequence[ClipResults], metric: str) -> TradePlot:
    """A point for each denoiser that was timed in the precision in which it was evaluated. Clips are of one signal."""
    compared: dict[str, Point | None] = {}
    means: dict[str, Point] = {}
    for result in clips[0].results:
        name = result.denoiser
        ms = times.of(DenoiserSpec.named(name, signal=result.signal, precision=result.precision))
        scores = scores_of(clips, name)
        compared[name] = Point.of(ms, scores.compared(metric))
        if mean := Point.of(ms, scores.means[metric]):
            means[name] = mean
    beaten = dominated_by_name(compared, metric)
    points = [PlotPoint(name, mean.ms, mean.quality, beaten[name]) for name, mean in means.items()]
    height, width = times.size
    return TradePlot(
        signal=clips[0].signal,
        metric=metric,
        points=sorted(points, key=lambda point: point.ms),
        missing=[name for name in compared if name not in beaten],
        size=f"{width} × {height}",
    )
