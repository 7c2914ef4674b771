"""`onespp report`: one HTML file with all results, and short animated pictures of clips, for slides."""

import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from datasets.clip import is_clip
from errors import BadInput, requires_extra
from eval.metrics import METRICS, flip_map
from eval.results import (
    ClipResults,
    by_signal,
    folders_of,
    heading,
    load_picture,
    of_one_spp,
    picture_path,
    read_results,
)
from eval.tables import LEGEND, MEAN, scores_of, table_rows
from eval.tradeoff.trades import Times, dominated_by_name, times_of_first_size
from files import replacing, write_file
from models.spec import DenoiserSpec
from plotting import Image, ImageDraw, ImageFont, data_uri, enlargement, plt, webp_uri
from provenance import ROOT
from timing import thread_count, threads_for

with requires_extra("report"):
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

WITH_FLIP_MAPS = 1.4  # bytes of images and their FLIP maps over those of images
BASE64 = 4 / 3  # bytes of text over those that it encodes
MOST_CROPS = 3  # a clip
PLOTTED = ("flip", "rmse", "ssim", "psnr", "temporal_error")  # against time; the page opens with the first
BEST_SHOWN = 2  # denoisers, in an animation
MAX_FRAMES = 240
MILLISECONDS = 83  # that each frame is shown
BANNER = 22  # px above the panels, for their names
LIVE_PAGE = "live.html"


def four_digits(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")


def chosen_crops(clip: ClipResults, frames: Sequence[int]) -> list[dict[str, int]]:
    """The crops with most disoccluded pixels, in shown frames that are not next to each other."""
    apart = max(1, len(clip.reference.frames) // 8)
    chosen: list[dict[str, int]] = []
    for crop in sorted(clip.reference.crops or [], key=lambda crop: -crop["pixels"]):
        far = all(abs(crop["frame"] - other["frame"]) >= apart for other in chosen)
        if crop["frame"] in frames and far and len(chosen) < MOST_CROPS:
            chosen.append(crop)
    return chosen


def curves_of(clip: ClipResults) -> dict[str, dict[str, list[float | None]]]:
    """The values of all denoisers and, as the reference's, the noise floors, by metrics that any frame defines."""
    curves = {}
    for metric in METRICS:
        values = {r.denoiser: [four_digits(frame.get(metric)) for frame in r.frames] for r in clip.results}
        if any(value is not None for frames in values.values() for value in frames):
            floors = [four_digits(frame.get(metric)) for frame in clip.reference.frames]
            curves[metric] = values | {clip.reference.denoiser: floors}
    return curves


def error_maps(folder: Path, frames: Sequence[int]) -> list[str]:
    """Data URIs of a denoiser's maps of the estimated error; empty unless there is one for each of `frames`."""
    paths = [picture_path(folder, index, "error-") for index in frames]
    return [data_uri(path.read_bytes(), "webp") for path in paths] if all(path.exists() for path in paths) else []


def page_clip(runs: Path, clip: ClipResults, step: int) -> dict[str, Any]:
    """The data of a clip, with pictures of every `step`-th frame as data URIs by denoiser.

    `images` also has those of the reference, and `errors` only denoisers that estimate theirs. Raises BadInput for
    missing and damaged pictures.
    """
    folders = folders_of(runs, clip)
    frames = clip.reference.judged[::step]
    height, width = load_picture(folders[clip.reference.denoiser], frames[0]).shape[:2]
    images = {
        name: [data_uri(picture_path(folder, index).read_bytes(), "webp") for index in frames]
        for name, folder in folders.items()
    }
    flips: dict[str, list[str]] = {result.denoiser: [] for result in clip.results}
    with thread_count(threads_for(height, width)):
        for index in tqdm(frames, clip.name, unit="frame", leave=False):
            reference = load_picture(folders[clip.reference.denoiser], index)
            for name, maps in flips.items():
                errors = flip_map(load_picture(folders[name], index) / 255, reference / 255)
                maps.append(webp_uri(errors, lossless=True, method=2))
    return {
        "name": clip.name,
        "count": len(clip.reference.frames),
        "frames": [*frames],  # those with pictures, of all `count`
        "height": height,
        "width": width,
        "images": images,
        "flips": flips,
        "errors": {name: maps for name, folder in folders.items() if (maps := error_maps(folder, frames))},
        "curves": curves_of(clip),
        "crops": chosen_crops(clip, frames),
    }


def trade_plots(times: Times, clips: Sequence[ClipResults]) -> list[dict[str, Any]]:
    """Plots of the mean of a metric against milliseconds, for each signal and metric, over the clips of 1 spp.

    Denoisers count with the time of the precision in which they were evaluated; those without a time or value are
    `missing`. Points are sorted, fastest first. `by` is the name that dominates a point; None on the Pareto front.
    """
    height, width = times.size
    plots = []
    for signal, ours in by_signal(of_one_spp(clips)).items():
        specs = {
            r.denoiser: DenoiserSpec.named(r.denoiser, signal=signal, precision=r.precision) for r in ours[0].results
        }
        ms = {name: times.of(spec) for name, spec in specs.items()}
        scores = {name: scores_of(ours, name) for name in specs}
        for metric in PLOTTED:
            by = dominated_by_name({name: (ms[name], scores[name].compared(metric)) for name in specs}, metric)
            points: list[dict[str, Any]] = [
                {"name": name, "ms": ms[name], "quality": scores[name].means[metric], "by": by[name]} for name in by
            ]
            points.sort(key=lambda point: point["ms"])
            missing = [name for name in specs if name not in by]
            plot = {"signal": signal, "metric": metric, "points": points, "missing": missing}
            plot["command"] = times.command(specs)
            plots += [plot | {"size": f"{width} × {height}"}] if points else []
    return plots


def render(results: dict[str, Any], clips: Sequence[ClipResults], runs: Path, megabytes: float, live: bool) -> str:
    """The page; `live` says whether to link to LIVE_PAGE."""
    times = times_of_first_size(runs)
    for warning in times.warnings if times else ():
        print(warning)
    paths = (path for clip in clips for folder in folders_of(runs, clip).values() for path in folder.glob("*.webp"))
    size = sum(path.stat().st_size for path in paths) * WITH_FLIP_MAPS * BASE64
    step = max(1, math.ceil(size / (megabytes * 1e6)))
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
    figures = sorted((runs / "report" / "figures").glob("*.png"))  # written by other commands
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = resources.files("eval.report") / "page"
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False}  # metrics and denoisers keep their order
    return environment.from_string((page / "template.html").read_text()).render(
        results=results,
        heading=heading(results),
        clips=clips,
        rows=rows,
        metrics=metrics,
        legend=LEGEND,
        mean=MEAN,
        times=times,
        figures=[{"name": path.stem.replace("-", " "), "uri": data_uri(path.read_bytes(), "png")} for path in figures],
        live=LIVE_PAGE if live else None,
        has_error_maps=any(clip["errors"] for clip in pictures),
        data=data,
        style=Markup((page / "style.css").read_text()),
        script=Markup((page / "script.js").read_text()),
    )


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

    From left to right it shows the noisy frame, the best denoisers by FLIP, and the reference. Returns its path. Raises
    BadInput for missing and damaged pictures.
    """
    flips = {result.denoiser: result.metrics["flip"] or 0.0 for result in clip.results}
    noisy = [name for name in flips if name == "noisy"]
    best = sorted((name for name in flips if name not in noisy), key=flips.__getitem__)[:BEST_SHOWN]
    names = [*noisy, *best, clip.reference.denoiser]
    folders = [folders_of(runs, clip)[name] for name in names]
    shown = clip.reference.judged[:MAX_FRAMES]
    frames: Iterator[Image.Image] = (side_by_side(folders, names, index) for index in shown)
    path = runs / "report" / f"{clip.file_name}.webp"
    first = next(frames)
    with replacing(path) as temporary:
        first.save(
            temporary, "WEBP", save_all=True, append_images=frames, duration=MILLISECONDS, loop=0, quality=90, method=2
        )
    return path


def save_live_page(runs: Path, data: Sequence[Path], clips: Sequence[ClipResults]) -> list[Path]:
    """Write RUNS/report/live.html, which denoises the last clip of 1 spp in the browser.

    Returns its path, or nothing where the clip or the C runtime is not at hand; prints why it cannot be compiled.
    """
    paths = (folder / "test" / clip.scene / clip.clip for clip in reversed(of_one_spp(clips)) for folder in data)
    clip = next(filter(is_clip, paths), None)
    if clip is None or not (ROOT / "runtime" / "web").is_dir():
        return []
    path = runs / "report" / LIVE_PAGE
    # In a process of its own, since `runtime` is no package of onespp where that is installed.
    command = [sys.executable, "-m", "runtime.web", str(clip.resolve()), str(path.resolve())]
    finished = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if finished.returncode:
        reason = finished.stderr.strip().splitlines() or [f"exit status {finished.returncode}"]
        print(f"no {LIVE_PAGE}: {reason[-1]}")
        return []
    return [path]


def report(runs: Path, megabytes: float = 24) -> list[Path]:
    """Write RUNS/report/index.html, an animated WebP per clip and, if possible, live.html; returns their paths.

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
    live = save_live_page(runs, [Path(folder) for folder in results["dataset"].split(", ")], clips)
    write_file(page, render(results, clips, runs, megabytes, live=bool(live)).encode())
    return [page, *live, *(save_animation(runs, clip) for clip in tqdm(clips, "animations", unit="clip"))]
