"""The data of the report page: pictures of a clip as data URIs, its curves and crops; quality against time."""

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from eval.means import scores_of
from eval.metrics import METRICS, flip_map
from eval.results import ClipResults, by_signal, error_path, folders_of, load_picture, of_one_spp, picture_path
from eval.tradeoff.trades import Times, dominated_by_name
from models.spec import DenoiserSpec
from plotting import Image
from timing import thread_count, threads_for

WITH_FLIP_MAPS = 1.4  # bytes of images and their FLIP maps over those of images
BASE64 = 4 / 3  # bytes of text over those that it encodes
MOST_CROPS = 3  # a clip
PLOTTED = ("flip", "rmse", "ssim", "psnr", "temporal_error")  # against time; the page opens with the first


def data_uri(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def webp_uri(image: NDArray[np.uint8]) -> str:
    """A data URI of an image (H, W) or (H, W, 3), lossless."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "WEBP", lossless=True, method=2)
    return data_uri(buffer.getvalue(), "webp")


def four_digits(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")


def step_for(runs: Path, clips: Sequence[ClipResults], size: float) -> int:
    """The n of "every n-th frame" with which all pictures take about `size` bytes."""
    paths = (path for clip in clips for folder in folders_of(runs, clip).values() for path in folder.glob("*.webp"))
    return max(1, math.ceil(sum(path.stat().st_size for path in paths) * WITH_FLIP_MAPS * BASE64 / size))


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
    paths = [error_path(folder, index) for index in frames]
    return [data_uri(path.read_bytes(), "webp") for path in paths] if all(path.exists() for path in paths) else []


def page_clip(runs: Path, clip: ClipResults, step: int) -> dict[str, Any]:
    """The data of a clip, with pictures of every `step`-th frame. Raises BadInput for missing and damaged pictures."""
    folders = folders_of(runs, clip)
    count = len(clip.reference.frames)
    frames = range(0, count, step)
    height, width = load_picture(folders[clip.reference.denoiser], 0).shape[:2]
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
                maps.append(webp_uri((255 * errors + 0.5).astype(np.uint8)))
    return {
        "name": clip.name,
        "count": count,
        "frames": [*frames],  # those with pictures, of all `count`
        "height": height,
        "width": width,
        "images": images,  # by denoiser, and that of the reference
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
            points = [
                {"name": name, "ms": ms[name], "quality": scores[name].means[metric], "by": by[name]}
                for name in sorted(by, key=ms.__getitem__)
            ]
            missing = [name for name in specs if name not in by]
            plot = {"signal": signal, "metric": metric, "points": points, "missing": missing}
            plots += [plot | {"size": f"{width} × {height}"}] if points else []
    return plots
