"""What is in a data set: clips, channels, render time, damaged files."""

import math
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from datasets.channels import CHANNELS, OPTIONAL_STEPS, USUAL_CHANNELS
from datasets.clip import Clip, Dataset, is_clip
from datasets.tonemap import psnr
from errors import BadInput

SecondsByStep = dict[str, float]


def summarise(root: Path) -> str:
    """Tables of clips, of channels and of steps. Raises BadInput where there is no data set at `root`."""
    dataset = Dataset(root)
    rows: list[dict[str, object]] = []
    clips: list[Clip] = []
    timings: list[SecondsByStep] = []
    for path in tqdm(dataset.planned(), "info", unit="clip", leave=False):
        rows.append({"clip": str(path.relative_to(root)), "frames": "missing"})
        if not is_clip(path):
            continue
        clip = Clip(path)
        clips.append(clip)
        timings.append(clip.seconds)
        rows[-1] |= {
            "frames": clip.frames,
            "size": f"{clip.width}x{clip.height}",
            "noisy": clip.realisations,
            "reference spp": clip.facts["reference_spp"],
            "floor dB": "unknown" if clip.is_imported else f"{psnr(clip.facts['floor_mse']):.1f}",
            "exposure": f"{clip.exposure:.3g}",
            "bad values": sum(clip.facts["nonfinite"].values()) + sum(clip.facts["clamped"].values()),
            "MB": megabytes(size_of(path)),
            "seconds": f"{sum(timings[-1].values()):.1f}",
        }
    facts = dataset.facts
    title = f"{root}: profile {facts['profile']}, seed {facts['seed']}, {megabytes(size_of(root))} MB"
    parts = [title, tabulate(rows, "keys")]
    if clips:
        parts += [channel_table(clips), step_table(clips, timings)]
    return "\n\n".join(parts)


def channel_table(clips: list[Clip]) -> str:
    """How channels are stored, and what that saves."""
    rows: list[list[str]] = []
    auxiliary = np.zeros(2, int)  # bytes as stored and in full, of what helps to denoise the noisy channels
    everything = np.zeros(2, int)
    for name, channel in CHANNELS.items():
        if name not in USUAL_CHANNELS and not any(name in clip.channels for clip in clips):
            continue
        sizes = np.sum([[stored_size(clip, name), size_in_full(clip, name)] for clip in clips], axis=0)
        rows.append([name, ", ".join(sorted({stored_as(clip, name) for clip in clips})), *map(megabytes, sizes)])
        everything += sizes
        if name in USUAL_CHANNELS and channel.kind not in ("noisy", "reference", "camera"):
            auxiliary += sizes
    for label, sizes in (("auxiliary channels", auxiliary), ("all", everything)):
        rows.append([label, f"{sizes[0] / sizes[1]:.0%} of full", *map(megabytes, sizes)])
    return tabulate(rows, ["channel", "stored as", "MB", "in full"], disable_numparse=True)


def step_table(clips: list[Clip], timings: list[SecondsByStep]) -> str:
    """Seconds by step, and what channels not rendered have saved, by the mean time per pixel of those that were."""
    steps = dict.fromkeys(step for timing in timings for step in timing)
    seconds = {step: sum(timing.get(step, 0.0) for timing in timings) for step in steps}
    pixels = [clip.frames * clip.height * clip.width for clip in clips]
    saved: dict[str, str] = {}
    for step in OPTIONAL_STEPS:
        rendered = sum(count for clip, count in zip(clips, pixels, strict=True) if step in clip.channels)
        if rendered and step in seconds:
            saved[step] = f"{seconds[step] * (sum(pixels) - rendered) / rendered:.2f}"
    rows = [[step, f"{spent:.2f}", saved.get(step, "")] for step, spent in seconds.items()]
    return tabulate(rows, ["step", "seconds", "saved"], disable_numparse=True)


def stored_as(clip: Clip, channel: str) -> str:
    """The data type of a channel that has a file, or else why it has none."""
    entry = clip.channels.get(channel, {})
    return str(entry.get("dtype") or next(iter(entry), "not rendered"))


def stored_size(clip: Clip, channel: str) -> int:
    """Bytes of a channel's file; 0 where it has none."""
    entry = clip.channels.get(channel, {})
    return (clip.path / entry["file"]).stat().st_size if "file" in entry else 0


def size_in_full(clip: Clip, channel: str) -> int:
    """Bytes that a channel would take with all its numbers written out."""
    meshes = len(clip.facts["meshes"])
    shape = CHANNELS[channel].shape(F=clip.frames, S=clip.realisations, H=clip.height, W=clip.width, M=meshes)
    return math.prod(shape) * np.dtype(clip.channels.get(channel, {}).get("dtype", CHANNELS[channel].dtype)).itemsize


def size_of(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def megabytes(count: int) -> str:
    return f"{count / 1e6:.1f}"


def find_problems(root: Path) -> list[str]:
    """Everything wrong with a data set, one line each. Raises BadInput where there is none at `root`."""
    progress = tqdm(Dataset(root).planned(), "verify", unit="clip", leave=False)
    return [problem for path in progress for problem in problems_of_clip(path)]


def problems_of_clip(path: Path) -> Iterator[str]:
    if not path.exists():
        yield f"{path} has not been rendered"
        return
    try:
        clip = Clip(path)
    except BadInput as error:
        yield str(error)
        return
    for name, entry in clip.channels.items():
        if name not in CHANNELS:
            yield f"{path}: clip.json has the unknown channel '{name}'"
        elif "file" in entry:
            try:
                clip.map(name)
            except BadInput as error:
                yield str(error)
                continue
            if f"{zlib.crc32(np.memmap(path / entry['file'], mode='r').data):08x}" != entry["crc32"]:
                yield f"{path / entry['file']} is damaged: its checksum is not {entry['crc32']}"
