"""Results on disk: a folder for each denoiser on each clip, complete or nothing, and the two files made of them all.

RUNS/eval/clips/SCENE-CLIP/DENOISER/ holds `result.json`, written last, and `0000.webp` and so on: what it shows, frame
by frame and lossless. The reference's folder beside them holds the noise floors. Folders of indirect light end in
`-indirect`.
"""

import csv
import hashlib
import io
import json
import platform
import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from datasets.clip import Clip
from datasets.clip_kind import ClipKind
from datasets.frame import Signal
from errors import BadInput
from eval.metrics import METRICS
from files import read_json, write_file, write_json

SIGNALS: tuple[Signal, ...] = ("total", "indirect")
REFERENCE, FLOOR = "reference", "(noise floor)"
BASELINES = ("noisy", "accumulated", "svgf")  # what denoisers of indirect light are compared with, on that alone
PACKAGES = ("onespp", "torch", "numpy", "numba", "flip-evaluator", "pyoidn")
RESULT, RESULTS, FRAMES = "result.json", "results.json", "frames.csv"
# What results follow from, besides packages, weights and clips.
SOURCES = (
    "models",
    "datasets/channels.py",
    "datasets/clip.py",
    "datasets/tonemap.py",
    "datasets/frame.py",
    "scenes/camera.py",
    "eval/metrics.py",
    "eval/disocclusion_crops.py",
    "eval/noise_floor.py",
    "eval/ssim.py",
    "eval/clip_run.py",
    "eval/harness.py",
)
KEYS = ("denoiser", "signal", "scene", "clip")

Values = dict[str, float | None]


def versions() -> dict[str, str]:
    """Of the packages that results follow from, as far as they are installed."""
    found = {}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            found[package] = version(package)
    return found


def device(kind: str = "cpu", threads: int | None = None) -> str:
    """What computes, in words; with all threads that PyTorch takes, unless told."""
    if kind == "cuda":
        return f"cuda, {torch.cuda.get_device_name()}"
    try:
        model = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
    except OSError:
        model = None
    return f"cpu, {model[1] if model else platform.machine()}, {threads or torch.get_num_threads()} threads"


@cache
def code(sources: tuple[str, ...] = SOURCES) -> str:
    """A digest of the code that results follow from."""
    root = Path(__file__).parent.parent
    files = [file for source in sources for file in ((root / source).rglob("*.py"), [root / source])["." in source]]
    return hashlib.sha256(b"".join(file.read_bytes() for file in sorted(files))).hexdigest()


def digest(file: str) -> str:
    with open(file, "rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def key(clip: Clip, **facts: Any) -> str:
    """A digest of all that a result follows from. clip.json has checksums of the clip's files."""
    everything = [digest(str(clip.path / "clip.json")), code(), versions(), facts]
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()


def label(name: str, signal: str) -> str:
    return name if signal == "total" else f"{name}-{signal}"


def folder_of(runs: Path, scene: str, clip: str, name: str, signal: str) -> Path:
    return runs / "eval" / "clips" / f"{scene}-{clip}" / label(name, signal)


def means(frames: list[Values]) -> Values:
    """Arithmetic means over the frames where a metric is defined, None where it never is."""
    columns = {name: [row[name] for row in frames if row[name] is not None] for name in frames[0]}
    return {name: float(np.mean(values)) if values else None for name, values in columns.items()}  # type: ignore[arg-type]


def mean_floor(frames: list[Values]) -> Values:
    """Noise floors of means over frames. The frames' noise is independent: standard errors add up as variances."""
    errors = [row["mse_unbiased"] for row in frames]
    return means(frames) | {"mse_unbiased": float(np.linalg.norm(errors) / len(errors))}  # type: ignore[arg-type]


def picture(folder: Path, index: int) -> Path:
    return folder / f"{index:04d}.webp"


def save_picture(folder: Path, index: int, image: NDArray[np.floating]) -> None:
    """Keep an image (H, W, 3) in [0, 1], rounded to 8 bits."""
    Image.fromarray((255 * image + 0.5).astype(np.uint8)).save(picture(folder, index), lossless=True, method=2)


def load_picture(folder: Path, index: int) -> NDArray[np.uint8]:
    """Raises BadInput where it is missing or damaged."""
    path = picture(folder, index)
    try:
        with Image.open(path) as image:
            return np.array(image.convert("RGB"))
    except OSError:
        raise BadInput(f"{path} is missing or damaged: delete {folder} and run `onespp eval` again") from None


@dataclass
class Result:
    """What is known of one denoiser (or the reference, with noise floors) on one clip and signal."""

    key: str
    denoiser: str
    signal: str
    scene: str
    clip: str
    metrics: Values  # means
    frames: list[Values]  # of each frame
    nonfinite: int = 0
    precision: str = "float32"
    crops: list[dict[str, int]] | None = None  # of the reference: where most comes into view

    @property
    def floor(self) -> bool:
        return self.denoiser == REFERENCE

    def save(self, runs: Path) -> None:
        write_json(folder_of(runs, self.scene, self.clip, self.denoiser, self.signal) / RESULT, vars(self))


def load_result(folder: Path) -> Result:
    """Raises BadInput where it is missing or damaged."""
    try:
        return Result(**read_json(folder / RESULT))
    except (TypeError, BadInput) as error:
        raise BadInput(f"{folder / RESULT} is missing or damaged ({error}): run `onespp eval` again") from None


def is_finished(folder: Path, wanted: str) -> bool:
    """Whether the folder's result is whole and follows from the same data, code and weights."""
    try:
        result = load_result(folder)
    except BadInput:
        return False
    return result.key == wanted and all(picture(folder, index).exists() for index in range(len(result.frames)))


def write_results(
    runs: Path, dataset: Path, device: str, results: list[Result], weights: Mapping[str, str | None]
) -> dict[str, Any]:
    """Write results.json and, frame by frame, frames.csv. Returns the content of results.json."""
    rows = [
        {
            "denoiser": result.denoiser,
            "signal": result.signal,
            "weights": weights[result.denoiser],
            "scene": result.scene,
            "clip": result.clip,
            "frames": len(result.frames),
            "metrics": result.metrics,
            "nonfinite": result.nonfinite,
        }
        for result in results
        if not result.floor
    ]
    content = {"schema": 1, "dataset": str(dataset), "device": device, "versions": versions(), "rows": rows}
    write_file(runs / "eval" / FRAMES, frames_csv(results).encode())
    write_json(runs / "eval" / RESULTS, content)
    return content


def frames_csv(results: list[Result]) -> str:
    """A line a frame of each result; noise floors are those of a denoiser called "(noise floor)"."""
    text = io.StringIO()
    lines = csv.DictWriter(text, [*KEYS, "frame", *METRICS], extrasaction="ignore", lineterminator="\n")
    lines.writeheader()
    for result in results:
        facts = {name: getattr(result, name) for name in KEYS} | ({"denoiser": FLOOR} if result.floor else {})
        lines.writerows(facts | {"frame": index} | values for index, values in enumerate(result.frames))
    return text.getvalue()


@dataclass
class ClipResults:
    """All denoisers of one signal on one clip."""

    scene: str
    clip: str
    signal: str
    tracks: list[Result]
    reference: Result

    @property
    def noisy_spp(self) -> int:
        return ClipKind.of(self.clip).noisy_spp

    @property
    def name(self) -> str:
        return f"{self.scene}/{self.clip}" + ("" if self.signal == "total" else f" ({self.signal} light)")


def folders_of(runs: Path, clip: ClipResults) -> dict[str, Path]:
    """The folders with pictures of all denoisers, and of the reference."""
    everyone = [*clip.tracks, clip.reference]
    return {r.denoiser: folder_of(runs, r.scene, r.clip, r.denoiser, r.signal) for r in everyone}


def by_clip(results: list[Result]) -> Iterator[ClipResults]:
    """In the order of clips, signals and denoisers."""
    groups: dict[tuple[str, str], list[Result]] = {}
    for result in results:
        groups.setdefault((result.scene, result.clip), []).append(result)
    for (scene, clip), group in groups.items():
        for signal in SIGNALS:
            ours = [result for result in group if result.signal == signal]
            if references := [result for result in ours if result.floor]:
                tracks = [result for result in ours if not result.floor]
                yield ClipResults(scene, clip, signal, tracks, references[0])


def read_results(runs: Path) -> tuple[dict[str, Any], list[ClipResults]]:
    """What the last evaluation left: results.json and, of each of its rows, the folder.

    Raises BadInput where there is none, or where files have changed since.
    """
    path = runs / "eval" / RESULTS
    if not path.exists():
        raise BadInput(f"there are no results at {path}: make them with `onespp eval --runs {runs}`")
    content = read_json(path, ("schema", "dataset", "device", "versions", "rows"))
    results = []
    for row in content["rows"]:
        facts = {name: row[name] for name in KEYS}
        folders = [
            folder_of(runs, row["scene"], row["clip"], name, row["signal"]) for name in (row["denoiser"], REFERENCE)
        ]
        ours, reference = (load_result(folder) for folder in folders)
        if ours.metrics != row["metrics"]:
            raise BadInput(f"{folders[0]} is not what {path} says of {facts}: run `onespp eval` again")
        if reference not in results:
            results.append(reference)
        results.append(ours)
    return content, list(by_clip(results))
