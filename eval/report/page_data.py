"""What the report's page shows of a clip: pictures as data URIs, curves, crops."""

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from tqdm import tqdm

from eval.metrics import METRICS, flip_map
from eval.results import ClipResults, folders_of, load_picture, picture_path

MAPS = 1.4  # bytes of images and their FLIP maps over those of images
BASE64 = 4 / 3
CROPS = 3  # a clip


def data_uri(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.4g}")


def encoded(image: NDArray[np.uint8]) -> str:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "WEBP", lossless=True, method=2)
    return data_uri(buffer.getvalue(), "webp")


def step_for(runs: Path, clips: Sequence[ClipResults], budget: float) -> int:
    """Of how many frames one is shown, so that all pictures take about `budget` bytes."""
    paths = (path for clip in clips for folder in folders_of(runs, clip).values() for path in folder.glob("*.webp"))
    return max(1, math.ceil(sum(path.stat().st_size for path in paths) * MAPS * BASE64 / budget))


def chosen_crops(clip: ClipResults, frames: Sequence[int]) -> list[dict[str, int]]:
    """The crops with the most disoccluded pixels, in frames that are shown and not next to each other."""
    apart = max(1, len(clip.reference.frames) // 8)
    chosen: list[dict[str, int]] = []
    for crop in sorted(clip.reference.crops or [], key=lambda crop: -crop["pixels"]):
        far = all(abs(crop["frame"] - other["frame"]) >= apart for other in chosen)
        if crop["frame"] in frames and far and len(chosen) < CROPS:
            chosen.append(crop)
    return chosen


def clip_data(runs: Path, clip: ClipResults, step: int) -> dict[str, Any]:
    """What the page needs of a clip: pictures as data URIs, errors frame by frame, crops."""
    everyone, folders, count = [*clip.results, clip.reference], folders_of(runs, clip), len(clip.reference.frames)
    frames = range(0, count, step)
    images: dict[str, list[str]] = {name: [] for name in folders}
    flips: dict[str, list[str]] = {track.denoiser: [] for track in clip.results}
    for index in tqdm(frames, clip.name, unit="frame", leave=False):
        shown = {name: load_picture(folder, index) for name, folder in folders.items()}
        for name, image in shown.items():
            images[name].append(data_uri(picture_path(folders[name], index).read_bytes(), "webp"))
            if name in flips:
                errors = flip_map(image / 255, shown[clip.reference.denoiser] / 255)
                flips[name].append(encoded((255 * errors + 0.5).astype(np.uint8)))
    height, width = shown[clip.reference.denoiser].shape[:2]
    curves = {
        metric: {r.denoiser: [rounded(values.get(metric)) for values in r.frames] for r in everyone}
        for metric in METRICS
        if any(values.get(metric) is not None for track in clip.results for values in track.frames)
    }
    facts = {"name": clip.name, "count": count, "frames": [*frames], "height": height, "width": width}
    return facts | {"images": images, "flips": flips, "curves": curves, "crops": chosen_crops(clip, frames)}
