"""The report's plot of quality against time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.means import compared_mean
from eval.metrics import METRICS
from eval.report.table_rows import by_signal, mean_of, of, one_spp
from eval.results import ClipResults
from eval.tradeoff.pareto import Point, dominators
from eval.tradeoff.times import median_ms, timed_as
from files import read_json

TRADED = ("flip", "rmse", "ssim", "psnr", "temporal_error")  # the first is shown at first


def trades(runs: Path, clips: Sequence[ClipResults]) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The bench's results, if there are any, and for each signal and metric the points of the plot."""
    path = runs / "bench" / "results.json"
    if not path.exists():
        return {}, []
    bench = read_json(path, ("device", "threads", "rows"))
    if not bench["rows"]:
        return {}, []
    height, width = (bench["rows"][0][side] for side in ("height", "width"))
    times = median_ms(bench, (height, width), bench["threads"])  # of the first size, with as many threads as there are
    plots = [
        trade(signal, ours, metric, times) | {"size": f"{width} × {height}"}
        for signal, ours in by_signal(one_spp(clips)).items()
        for metric in TRADED
    ]
    return bench, [plot for plot in plots if plot["points"]]


def trade(
    signal: str, clips: Sequence[ClipResults], metric: str, times: dict[tuple[str, str], float]
) -> dict[str, Any]:
    """A point for each denoiser that was timed in the precision in which it was evaluated."""
    floors = [clip.reference.metrics for clip in clips]
    points, values = dict[str, Point](), dict[str, float]()
    for track in clips[0].results:
        ms = times.get((timed_as(track.denoiser, signal), track.precision))
        quality = mean_of(clips, track.denoiser)[metric]
        seen = compared_mean(metric, [result.metrics for result in of(clips, track.denoiser)], floors)
        if ms is not None and quality is not None and seen is not None:
            points[track.denoiser], values[track.denoiser] = Point(ms, seen), quality
    by = dominators(points, METRICS[metric].more_is_better)
    missing = [track.denoiser for track in clips[0].results if track.denoiser not in points]
    shown = [{"name": name, "ms": points[name].ms, "quality": values[name], "by": by[name]} for name in points]
    return {"signal": signal, "metric": metric, "points": shown, "missing": missing}
