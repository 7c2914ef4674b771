"""The data of a clip on the report page: pictures as data URIs, curves, crops."""

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from eval.metrics import METRICS, flip_map
from eval.results import ClipResults, error_path, folders_of, load_picture, picture_path
from plotting import Image
from timing import thread_count, threads_for

WITH_FLIP_MAPS = 1.4  # bytes of images and their FLIP maps over those of images
BASE64 = 4 / 3  # bytes of text over those that it encodes
MOST_CROPS = 3  # a clip


@dataclass(frozen=True)
class PageClip:
    """A clip on the page."""

    name: str
    count: int  # number of its frames
    frames: list[int]  # those with pictures
    height: int
    width: int
    images: dict[str, list[str]]  # data URIs of the pictures of each denoiser and of the reference
    flips: dict[str, list[str]]  # data URIs of each denoiser's FLIP maps
    errors: dict[str, list[str]]  # data URIs of the maps of estimated errors, of denoisers that have them
    # each metric in all frames, of each denoiser, and as the reference's its noise floor
    curves: dict[str, dict[str, list[float | None]]]
    crops: list[dict[str, int]]  # the windows with most disocclusions


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
    """The values of all denoisers and the noise floors, for each metric that is defined in any frame."""
    defined = [
        metric
        for metric in METRICS
        if any(values.get(metric) is not None for result in clip.results for values in result.frames)
    ]
    return {
        metric: {
            result.denoiser: [four_digits(values.get(metric)) for values in result.frames]
            for result in (*clip.results, clip.reference)
        }
        for metric in defined
    }


def error_maps(folder: Path, frames: Sequence[int]) -> list[str]:
    """Data URIs of a denoiser's maps of the estimated error; empty unless there is one for each of `frames`."""
    paths = [error_path(folder, index) for index in frames]
    return [data_uri(path.read_bytes(), "webp") for path in paths] if all(path.exists() for path in paths) else []


def page_clip(runs: Path, clip: ClipResults, step: int) -> PageClip:
    """The data of a clip, with pictures of every `step`-th frame. Raises BadInput for missing and damaged pictures."""
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
                maps.append(webp_uri((255 * errors + 0.5).astype(np.uint8)))
    return PageClip(
        name=clip.name,
        count=len(clip.reference.frames),
        frames=frames,
        height=height,
        width=width,
        images=images,
        flips=flips,
        errors={name: maps for name, folder in folders.items() if (maps := error_maps(folder, frames))},
        curves=curves_of(clip),
        crops=chosen_crops(clip, frames),
    )
