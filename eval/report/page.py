"""`onespp report`: one HTML file with all results."""

from collections.abc import Sequence
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from errors import BadInput
from eval.metrics import METRICS
from eval.report.animation import save_animation
from eval.report.page_data import data_uri, page_clip, step_for
from eval.report.table_rows import table_rows
from eval.report.trade_plot import trade_plots
from eval.results import ClipResults, read_results
from eval.text_table import LEGEND
from eval.tradeoff.times import times_of_first_size
from extras import requires_extra
from files import write_file
from plotting import plt

with requires_extra("report"):
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup


def figures(runs: Path) -> list[dict[str, str]]:
    """The PNGs in RUNS/report/figures, written by other commands."""
    paths = sorted((runs / "report" / "figures").glob("*.png"))
    return [{"name": path.stem.replace("-", " "), "uri": data_uri(path.read_bytes(), "png")} for path in paths]


def page_file(name: str) -> str:
    return resources.files("eval.report").joinpath("page", name).read_text()


def render(results: dict[str, Any], clips: Sequence[ClipResults], runs: Path, megabytes: float) -> str:
    """The page's HTML."""
    times = times_of_first_size(runs)
    plots = trade_plots(times, clips) if times else []
    step = step_for(runs, clips, megabytes * 1e6)
    pictures = [page_clip(runs, clip, step) for clip in tqdm(clips, "report", unit="clip")]
    rows = table_rows(clips)
    metrics = {key: METRICS[key] for key in METRICS if any(row.values.get(key) is not None for row in rows)}
    data = {
        "metrics": {key: {"title": metric.title, "more": metric.more_is_better} for key, metric in metrics.items()},
        "denoisers": list(dict.fromkeys(result.denoiser for clip in clips for result in clip.results)),
        "magma": (255 * plt.get_cmap("magma")(np.arange(256))[:, :3]).round().astype(int).tolist(),
        "clips": [asdict(clip) for clip in pictures],
        "trades": [asdict(plot) for plot in plots],
    }
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False}  # metrics and denoisers keep their order
    return environment.from_string(page_file("template.html")).render(
        results=results,
        clips=clips,
        rows=rows,
        metrics=metrics,
        legend=LEGEND,
        times=times,
        figures=figures(runs),
        has_error_maps=any(clip.errors for clip in pictures),
        data=data,
        style=Markup(page_file("style.css")),
        script=Markup(page_file("script.js")),
    )


def report(runs: Path, megabytes: float = 24) -> list[Path]:
    """Write RUNS/report/index.html and an animated WebP per clip; returns their paths.

    Pictures take about `megabytes` at most: if all frames do not fit, the page shows every n-th. Raises BadInput
    without results and where they are damaged.
    """
    if megabytes <= 0:
        raise BadInput(f"{megabytes} megabytes are too few for a page: name more than 0")
    results, clips = read_results(runs)
    if not clips:
        raise BadInput(f"{runs / 'eval' / 'results.json'} has no rows: run `onespp eval` again")
    page = runs / "report" / "index.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    write_file(page, render(results, clips, runs, megabytes).encode())
    return [page, *(save_animation(runs, clip) for clip in tqdm(clips, "animations", unit="clip"))]
