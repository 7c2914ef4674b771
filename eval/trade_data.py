"""The report's plot of quality against time."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from datasets.files import read_json
from eval.metrics import METRICS
from eval.pareto import Point, dominators
from eval.results import ClipResults
from eval.rows import by_signal, mean_of

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
        for signal, ours in by_signal(clips).items()
        for metric in TRADED
    ]
    return bench, [plot for plot in plots if plot["points"]]


def trade(
    signal: str, clips: Sequence[ClipResults], metric: str, times: dict[tuple[str, str], float]
) -> dict[str, Any]:
    """A point for each denoiser that was timed in the precision in which it was evaluated."""
    points = {}
    for track in clips[0].tracks:
        ms, quality = times.get((track.denoiser, track.precision)), mean_of(clips, track.denoiser)[metric]
        if ms is not None and quality is not None:
            points[track.denoiser] = Point(ms, quality)
    by = dominators(points, METRICS[metric].more_is_better)
    missing = [track.denoiser for track in clips[0].tracks if track.denoiser not in points]
    shown = [{"name": name, **point._asdict(), "by": by[name]} for name, point in points.items()]
    return {"signal": signal, "metric": metric, "points": shown, "missing": missing}
