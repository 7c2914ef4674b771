"""What is in a data set: clips and how hard their light is to reconstruct, channels, render time, damaged files."""

import math
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from datasets.channels import ALBEDO_FLOOR, CHANNELS, OPTIONAL_STEPS, USUAL_CHANNELS
from datasets.clip import Clip, Dataset, is_clip
from datasets.tonemap import luminance, psnr
from errors import BadInput
from files import read_json

if TYPE_CHECKING:
    from plotting import Figure

BINS = 16  # of histograms
MAX_MEASURED_FRAMES = 8  # spread evenly over a clip

SecondsByStep = dict[str, float]


class Difficulty(NamedTuple):
    """Measures of the luminance of irradiance on surfaces."""

    zeros: float  # share of pixels that are exactly black at 1 spp
    relative_mse: float  # mean((x - r)^2) / mean(r)^2 of 1 spp x against the reference r
    peak: float  # 99.9th percentile of 1 spp over its mean
    contrast: float  # 95th over 5th percentile of the reference; infinite where a twentieth is black


class Measure(NamedTuple):
    head: str  # of its column in tables
    title: str  # of its histogram
    minimum: float  # of the histogram's axis; smaller values are shown there


MEASURES = {  # by field of Difficulty
    "zeros": Measure("zeros", "share of black pixels at 1 spp", 1e-3),
    "relative_mse": Measure("rel. MSE", "relative MSE at 1 spp", 1e-2),
    "peak": Measure("P99.9/mean", "P99.9 over mean at 1 spp", 1.0),
    "contrast": Measure("P95/P5", "P95 over P5 of the reference", 1.0),
}


def difficulty_of_clip(clip: Clip) -> Difficulty:
    """The mean over up to MAX_MEASURED_FRAMES frames of a clip, in its first noise realisation.

    Measures are NaN where a frame shows no surface, or none that is lit.
    """
    frames = np.unique(np.linspace(0, clip.frames - 1, MAX_MEASURED_FRAMES).round().astype(int))
    with np.errstate(divide="ignore", invalid="ignore"):
        measured = [difficulty_of_frame(clip, int(frame)) for frame in frames]
    return Difficulty(*np.mean(measured, axis=0))


def difficulty_of_frame(clip: Clip, frame: int) -> Difficulty:
    albedo = np.maximum(clip.read("albedo", frame).astype(np.float64), ALBEDO_FLOOR)
    surface = clip.read("mesh_id", frame)[..., 0] > 0
    if not surface.any():
        return Difficulty(*[math.nan] * len(MEASURES))
    light = clip.read("direct", frame).astype(np.float64) + clip.read("indirect", frame)
    buffers = clip.read("direct_reference", frame).astype(np.float64) + clip.read("indirect_reference", frame)
    noisy = luminance(light / albedo)[surface]
    reference = luminance(buffers / albedo).mean(axis=0)[surface]
    low, high = np.percentile(reference, [5, 95])
    return Difficulty(
        zeros=float((noisy == 0).mean()),
        relative_mse=float(((noisy - reference) ** 2).mean() / reference.mean() ** 2),
        peak=float(np.percentile(noisy, 99.9) / noisy.mean()),
        contrast=float(high / low),
    )


def summarise(root: Path, plot: Path | None = None) -> str:
    """Tables of clips (size, noise floor, difficulty, render time), of channels (storage, savings) and of steps.

    With `plot`, histograms of the clips' difficulty are written there as a PNG.
    Raises BadInput where there is no data set at `root`, or no clip to plot.
    """
    dataset = Dataset(root)
    rows: list[dict[str, object]] = []
    clips: list[Clip] = []
    difficulties: list[Difficulty] = []
    timings: list[SecondsByStep] = []
    for path in tqdm(dataset.planned(), "info", unit="clip", leave=False):
        label = str(path.relative_to(root))
        if not is_clip(path):
            rows.append({"clip": label, "frames": "missing"})
            continue
        clips.append(Clip(path))
        difficulties.append(difficulty_of_clip(clips[-1]))
        timings.append(read_json(path / "timing.json"))
        rows.append({"clip": label, **clip_row(clips[-1], difficulties[-1], sum(timings[-1].values()))})
    if plot:
        if not difficulties:
            raise BadInput(f"{root} has no clips yet: render some with `onespp dataset`")
        from plotting import save_figure  # takes matplotlib, which tables do not need

        save_figure(plot, difficulty_histograms(difficulties))
    facts = dataset.facts
    title = f"{root}: profile {facts['profile']}, seed {facts['seed']}, {megabytes(size_of(root))} MB"
    parts = [title, tabulate(rows, "keys")]
    if clips:
        parts += [channel_table(clips), step_table(clips, timings)]
    return "\n\n".join(parts)


def difficulty_histograms(clips: Sequence[Difficulty]) -> "Figure":
    """A histogram of each measure over all clips, on logarithmic axes. Infinite and undefined values are left out."""
    from plotting import plt

    figure, axes = plt.subplots(1, len(MEASURES), figsize=(12, 2.6), layout="constrained")
    for axis, (field, measure) in zip(axes, MEASURES.items(), strict=True):
        values = np.array([getattr(clip, field) for clip in clips])
        finite = np.maximum(values[np.isfinite(values)], measure.minimum)
        maximum = max(finite.max(initial=measure.minimum), 2 * measure.minimum)
        bins = np.geomspace(measure.minimum, maximum * 1.0001, BINS + 1)
        axis.hist(finite, bins, color="#4477aa", edgecolor="white")
        axis.set(xscale="log", xlabel=measure.title)
        if len(finite):
            low, middle, high = np.percentile(finite, [5, 50, 95])
            axis.set_title(f"5 %: {low:.2g}   50 %: {middle:.2g}   95 %: {high:.2g}", fontsize=8)
    axes[0].set_ylabel(f"clips of {len(clips)}")
    return figure


def clip_row(clip: Clip, difficulty: Difficulty, seconds: float) -> dict[str, object]:
    return {
        "frames": clip.frames,
        "size": f"{clip.height}x{clip.width}",
        "noisy": clip.realisations,
        "reference spp": clip.facts["reference_spp"],
        "floor dB": f"{psnr(clip.facts['floor_mse']):.1f}",
        "exposure": f"{clip.exposure:.3g}",
        "bad values": sum(clip.facts["nonfinite"].values()) + sum(clip.facts["clamped"].values()),
        **{measure.head: f"{getattr(difficulty, field):.3g}" for field, measure in MEASURES.items()},
        "MB": megabytes(size_of(clip.path)),
        "seconds": f"{seconds:.1f}",
    }


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
    seconds: SecondsByStep = {}
    for timing in timings:
        for step, spent in timing.items():
            seconds[step] = seconds.get(step, 0.0) + spent
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
