"""The report's plot of quality against time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from eval.metrics import METRICS
from eval.report.table_rows import by_signal, mean_of, of, one_spp
from eval.results import ClipResults
from eval.sizes import timed_as
from eval.text_table import compared
from eval.tradeoff.pareto import Point, dominators
from files import read_json

TRADED = ("flip", "rmse", "ssim", "psnr", "temporal_error")  # the first is shown at first


def median_ms(bench: dict[str, Any], size: tuple[int, int], threads: int) -> dict[tuple[str, str], float]:
    """Milliseconds by (denoiser, dtype) in the bench's results, at a size (height, width) and a number of threads."""
    return {
        (row["denoiser"], row["dtype"]): row["ms_median"]
        for row in bench["rows"]
        if (row["height"], row["width"], row.get("threads", bench["threads"])) == (*size, threads)
    }


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
    for track in clips[0].tracks:
        ms = times.get((timed_as(track.denoiser, signal), track.precision))
        quality = mean_of(clips, track.denoiser)[metric]
        seen = compared(metric, [result.metrics for result in of(clips, track.denoiser)], floors)
        if ms is not None and quality is not None and seen is not None:
            points[track.denoiser], values[track.denoiser] = Point(ms, seen), quality
    by = dominators(points, METRICS[metric].more_is_better)
    missing = [track.denoiser for track in clips[0].tracks if track.denoiser not in points]
    shown = [{"name": name, "ms": points[name].ms, "quality": values[name], "by": by[name]} for name in points]
    return {"signal": signal, "metric": metric, "points": shown, "missing": missing}
