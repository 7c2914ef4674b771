"""`onespp report`: one HTML file with all results, and short animated pictures of clips, for slides."""

from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from errors import BadInput
from eval.metrics import METRICS
from eval.report.page_data import data_uri, page_clip, step_for, trade_plots
from eval.results import ClipResults, folders_of, load_picture, read_results, signal_label
from eval.tables import LEGEND, table_rows
from eval.tradeoff.trades import times_of_first_size
from extras import requires_extra
from files import replacing, write_file
from plotting import Image, ImageDraw, ImageFont, enlargement, plt

with requires_extra("report"):
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

BEST_SHOWN = 2  # denoisers, in an animation
MAX_FRAMES = 240
MILLISECONDS = 83  # that each frame is shown
BANNER = 22  # px above the panels, for their names


def figures(runs: Path) -> list[dict[str, str]]:
    """The PNGs in RUNS/report/figures, written by other commands."""
    paths = sorted((runs / "report" / "figures").glob("*.png"))
    return [{"name": path.stem.replace("-", " "), "uri": data_uri(path.read_bytes(), "png")} for path in paths]


def page_file(name: str) -> str:
    return resources.files("eval.report").joinpath("page", name).read_text()


def render(results: dict[str, Any], clips: Sequence[ClipResults], runs: Path, megabytes: float) -> str:
    """The page's HTML."""
    times = times_of_first_size(runs)
    step = step_for(runs, clips, megabytes * 1e6)
    pictures = [page_clip(runs, clip, step) for clip in tqdm(clips, "report", unit="clip")]
    rows = table_rows(clips)
    metrics = {key: METRICS[key] for key in METRICS if any(row.values.get(key) is not None for row in rows)}
    data = {
        "metrics": {key: {"title": metric.title, "more": metric.more_is_better} for key, metric in metrics.items()},
        "denoisers": list(dict.fromkeys(result.denoiser for clip in clips for result in clip.results)),
        "magma": (255 * plt.get_cmap("magma")(np.arange(256))[:, :3]).round().astype(int).tolist(),
        "clips": pictures,
        "trades": trade_plots(times, clips) if times else [],
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
        has_error_maps=any(clip["errors"] for clip in pictures),
        data=data,
        style=Markup(page_file("style.css")),
        script=Markup(page_file("script.js")),
    )


def panel_names(clip: ClipResults) -> list[str]:
    """The panels from left to right: the noisy frame, the best denoisers by FLIP, the reference."""
    flips = {result.denoiser: result.metrics["flip"] or 0.0 for result in clip.results if result.denoiser != "noisy"}
    noisy = [result.denoiser for result in clip.results if result.denoiser == "noisy"]
    return [*noisy, *sorted(flips, key=flips.__getitem__)[:BEST_SHOWN], clip.reference.denoiser]


def side_by_side(folders: Sequence[Path], names: Sequence[str], index: int) -> Image.Image:
    """Frame `index` of each of the folders, side by side, with names above."""
    images = [load_picture(folder, index) for folder in folders]
    zoom = enlargement(*images[0].shape[:2])
    panels = Image.fromarray(np.concatenate([image.repeat(zoom, 0).repeat(zoom, 1) for image in images], axis=1))
    picture = Image.new("RGB", (panels.width, panels.height + BANNER), "white")
    picture.paste(panels, (0, BANNER))
    for position, name in enumerate(names):
        left = position * panels.width // len(names)
        ImageDraw.Draw(picture).text((left + 4, 3), name, "black", ImageFont.load_default(14))
    return picture


def save_animation(runs: Path, clip: ClipResults) -> Path:
    """Write RUNS/report/SCENE-CLIP.webp, a loop over at most MAX_FRAMES frames of the clip.

    Returns its path. Raises BadInput for missing and damaged pictures.
    """
    names = panel_names(clip)
    folders = [folders_of(runs, clip)[name] for name in names]
    count = min(MAX_FRAMES, len(clip.reference.frames))
    frames: Iterator[Image.Image] = (side_by_side(folders, names, index) for index in range(count))
    path = runs / "report" / f"{signal_label(f'{clip.scene}-{clip.clip}', clip.signal)}.webp"
    first = next(frames)
    with replacing(path) as temporary:
        first.save(
            temporary, "WEBP", save_all=True, append_images=frames, duration=MILLISECONDS, loop=0, quality=90, method=2
        )
    return path


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
