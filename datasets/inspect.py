"""What is in a data set, and whether it is undamaged."""

import math
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from datasets.channels import ALBEDO_FLOOR, CHANNELS
from datasets.clip import Clip, Dataset, is_clip
from datasets.tonemap import luminance, psnr
from errors import BadInput
from files import read_json

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


def stored_as(clip: Clip, name: str) -> str:
    entry = clip.channels.get(name, {})
    if "file" in entry:
        return str(entry["dtype"])
    return next((kind for kind in ("value", "derived") if kind in entry), "not rendered")


def size_in_full(clip: Clip, name: str) -> int:
    """Bytes that a channel would take with all its numbers written out."""
    if "shape" in clip.channels.get(name, {}):
        entry = clip.channels[name]
        return math.prod(entry["shape"]) * np.dtype(entry["dtype"]).itemsize
    meshes = len(clip.facts["meshes"])
    shape = CHANNELS[name].shape(F=clip.frames, S=clip.realisations, H=clip.height, W=clip.width, M=meshes)
    return math.prod(shape) * np.dtype(CHANNELS[name].dtype).itemsize


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
    albedo = np.maximum(clip.read("albedo", frame).astype(np.float64), ALBEDO_FLOOR)
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


def clip_row(clip: Clip, label: str, measured: Difficulty, seconds: float) -> list[object]:
    lost = sum(clip.facts["nonfinite"].values()) + sum(clip.facts["clamped"].values())
    return [
        *(label, clip.frames, f"{clip.height}x{clip.width}", clip.realisations, clip.facts["reference_spp"]),
        *(f"{psnr(clip.facts['floor_mse']):.1f}", f"{clip.exposure:.3g}", lost),
        *(f"{measure:.3g}" for measure in measured),
        *(f"{size_of(clip.path) / 1e6:.1f}", f"{seconds:.1f}"),
    ]


CLIP_HEAD = [
    *("clip", "frames", "size", "noisy", "reference spp", "floor dB", "exposure", "bad values"),
    *("zeros", "rel. MSE", "P99.9/mean", "P95/P5", "MB", "seconds"),
]


def info(root: Path, plot: Path | None = None) -> str:
    """Tables of clips (size, noise floor, difficulty, render time), of channels (storage, savings) and of steps.

    With `plot` a histogram of the difficulties is written there; raises BadInput where there is no clip to draw.
    """
    dataset = Dataset(root)
    rows: list[list[object]] = []
    clips: list[Clip] = []
    measures: list[Difficulty] = []
    seconds: dict[str, float] = {}
    for path in tqdm(dataset.planned(), "info", unit="clip", leave=False):
        label = str(path.relative_to(root))
        if not is_clip(path):
            rows.append([label, "missing"])
            continue
        clips.append(Clip(path))
        measures.append(difficulty(clips[-1]))
        timing = read_json(path / "timing.json")
        rows.append(clip_row(clips[-1], label, measures[-1], sum(timing.values())))
        for step, spent in timing.items():
            seconds[step] = seconds.get(step, 0.0) + spent
    if plot:
        if not measures:
            raise BadInput(f"{root} has no clips yet: render some with `onespp dataset`")
        from datasets.histogram import plot_difficulty  # matplotlib, which nothing else here needs

        plot_difficulty(measures, plot)
    facts = dataset.facts
    title = f"{root}: profile {facts['profile']}, seed {facts['seed']}, {size_of(root) / 1e6:.1f} MB"
    if not clips:
        return "\n\n".join([title, tabulate(rows, CLIP_HEAD)])
    return "\n\n".join([title, tabulate(rows, CLIP_HEAD), channel_table(clips), step_table(clips, seconds)])


def channel_table(clips: list[Clip]) -> str:
    """How channels are stored, and what that saves."""
    rows: list[list[object]] = []
    totals = np.zeros((2, 2))
    for name, channel in CHANNELS.items():
        entries = [clip.channels.get(name, {}) for clip in clips]
        files = [clip.path / e["file"] for clip, e in zip(clips, entries, strict=True) if "file" in e]
        stored, full = sum(file.stat().st_size for file in files), sum(size_in_full(clip, name) for clip in clips)
        kinds = sorted({stored_as(clip, name) for clip in clips})
        rows.append([name, ", ".join(kinds), f"{stored / 1e6:.1f}", f"{full / 1e6:.1f}"])
        totals[int((channel.is_image and not channel.radiance) or name == "emission")] += [stored / 1e6, full / 1e6]
    both, auxiliary = totals.sum(axis=0), totals[1]
    for label, (stored, full) in (("auxiliary channels", auxiliary), ("all", both)):
        rows.append([label, f"{stored / full:.0%} of full", f"{stored:.1f}", f"{full:.1f}"])
    return tabulate(rows, ["channel", "stored as", "MB", "in full"], disable_numparse=True)


def step_table(clips: list[Clip], seconds: dict[str, float]) -> str:
    """Seconds by step, and what skipping saved: by the step's mean time a pixel in the clips that have the channel."""
    rows = [[step, f"{spent:.2f}", ""] for step, spent in seconds.items()]
    pixels = {True: 0, False: 0}
    for clip in clips:
        pixels["dual_motion" in clip.channels] += clip.frames * clip.height * clip.width
    if pixels[True] and "dual_motion" in seconds:
        saved = seconds["dual_motion"] * pixels[False] / pixels[True]
        rows = [[*row[:2], f"{saved:.2f}" if row[0] == "dual_motion" else ""] for row in rows]
    return tabulate(rows, ["step", "seconds", "saved"], disable_numparse=True)
