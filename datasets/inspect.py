"""What is in a data set, and whether it is undamaged."""

import math
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from datasets.channels import CHANNELS
from datasets.clip import Clip, Dataset, is_clip
from datasets.display import luminance, psnr
from datasets.files import read_json
from errors import BadInput

CHUNK = 1 << 24


def file_crc32(path: Path) -> str:
    checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            checksum = zlib.crc32(chunk, checksum)
    return f"{checksum:08x}"


def check_clip(path: Path) -> list[str]:
    """Everything wrong with one clip, one line each, naming the file."""
    if not path.exists():
        return [f"{path} has not been rendered"]
    try:
        clip = Clip(path)
    except BadInput as error:
        return [str(error)]
    problems = [f"{path}: clip.json has the unknown channel '{name}'" for name in clip.channels if name not in CHANNELS]
    for name, entry in clip.channels.items():
        if "file" not in entry or name not in CHANNELS:
            continue
        try:
            clip.map(name)
        except BadInput as error:
            problems.append(str(error))
            continue
        if file_crc32(path / entry["file"]) != entry["crc32"]:
            problems.append(f"{path / entry['file']} is damaged: its checksum is not {entry['crc32']}")
    return problems


def verify(root: Path) -> list[str]:
    """Everything wrong with a data set, one line each."""
    paths = Dataset(root).planned()
    return [problem for path in tqdm(paths, "verify", unit="clip", leave=False) for problem in check_clip(path)]


def size_of(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def stored_as(entry: dict[str, object]) -> str:
    if "file" in entry:
        return str(entry["dtype"])
    return "value" if "value" in entry else "derived"


class Difficulty(NamedTuple):
    """How hard a clip's light is to reconstruct, from the luminance of irradiance on surfaces, mean over frames."""

    zeros: float  # share of pixels that are exactly black at 1 spp
    relative_mse: float  # mean((x - r)^2) / mean(r)^2 of 1 spp against the reference
    peak: float  # 99.9th percentile of 1 spp over its mean
    contrast: float  # 95th over 5th percentile of the reference; infinite where a twentieth is black


MEASURED_FRAMES = 8  # spread evenly over a clip


def difficulty(clip: Clip) -> Difficulty:
    """Measure a clip on at most eight of its frames, realisation 0. NaN where no surface is seen or no light falls."""
    frames = np.unique(np.linspace(0, clip.frames - 1, MEASURED_FRAMES).round().astype(int))
    with np.errstate(divide="ignore", invalid="ignore"):
        measured = [measure_frame(clip, int(frame)) for frame in frames]
    return Difficulty(*np.mean(measured, axis=0))


def measure_frame(clip: Clip, frame: int) -> Difficulty:
    albedo = np.maximum(clip.read("albedo", frame).astype(np.float64), 0.01)
    surface = clip.read("mesh_id", frame)[..., 0] > 0
    x, r = (
        luminance(sum(clip.read(name + kind, frame).astype(np.float64) for name in ("direct", "indirect")) / albedo)
        for kind in ("", "_reference")
    )
    x, r = x[surface], r.mean(axis=0)[surface]
    if not x.size:
        return Difficulty(*[math.nan] * 4)
    low, high = np.percentile(r, [5, 95])
    return Difficulty(
        float((x == 0).mean()),
        float(((x - r) ** 2).mean() / r.mean() ** 2),
        float(np.percentile(x, 99.9) / x.mean()),
        float(high / low),
    )


def info(root: Path) -> str:
    """Tables of clips (size, noise floor, difficulty, render time) and of channels (storage, size)."""
    dataset = Dataset(root)
    rows: list[list[object]] = []
    sizes, storage = dict.fromkeys(CHANNELS, 0), {name: set[str]() for name in CHANNELS}
    for path in dataset.planned():
        label = str(path.relative_to(root))
        if not is_clip(path):
            rows.append([label, "missing"])
            continue
        clip = Clip(path)
        for name, entry in clip.channels.items():
            storage[name].add(stored_as(entry))
            sizes[name] += (path / entry["file"]).stat().st_size if "file" in entry else 0
        seconds = sum(read_json(path / "timing.json").values())
        lost = sum(clip.facts["nonfinite"].values()) + sum(clip.facts["clamped"].values())
        rows.append(
            [
                *(label, clip.frames, f"{clip.height}x{clip.width}", clip.realisations, clip.facts["reference_spp"]),
                *(f"{psnr(clip.facts['floor_mse']):.1f}", f"{clip.exposure:.3g}", lost),
                *(f"{measure:.3g}" for measure in difficulty(clip)),
                *(f"{size_of(path) / 1e6:.1f}", f"{seconds:.1f}"),
            ]
        )
    head = ["clip", "frames", "size", "noisy", "reference spp", "floor dB", "exposure", "bad values"]
    head += ["zeros", "rel. MSE", "P99.9/mean", "P95/P5", "MB", "seconds"]
    channels = [[n, ", ".join(sorted(storage[n])), f"{sizes[n] / 1e6:.1f}"] for n in CHANNELS if storage[n]]
    facts = dataset.facts
    title = f"{root}: profile {facts['profile']}, seed {facts['seed']}, {size_of(root) / 1e6:.1f} MB"
    tables = [tabulate(rows, head), tabulate(channels, ["channel", "stored as", "MB"], disable_numparse=True)]
    return "\n\n".join([title, *tables])
