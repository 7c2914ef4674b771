"""More samples per pixel: a dataset's clips with other noisy input, rendered and stored; and what samples cost."""

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.channels import CHANNELS, NOISY_CHANNELS, SAMPLE_BUFFERS
from datasets.clip import Clip, Dataset
from errors import BadInput
from files import crc32_of, locked, read_json, write_json
from render.backend import VARIANT, dr
from render.clip import Options, Sampling, render_clip
from render.job.generate import check_versions
from render.job.plan import GENERATOR, scene_of_clip
from render.job.profiles import profile_of, source_of
from render.path import PathTracer
from render.sampler import CYCLE
from render.stage import Stage
from scenes.animation import Scene
from timing import take_turns

RENDERER = VARIANT.partition("_")[0].replace("llvm", "cpu")  # the device that renders: cpu or cuda
TIMED_SPP = (1, 2, 4, 8)
TIMED_FRAMES_EACH = 3  # after a first one, which compiles kernels

NoisyFrame = dict[str, NDArray[np.floating]]  # of each of NOISY_CHANNELS (H, W, 3), of SAMPLE_BUFFERS (2, H, W, 3)


def scene_of(clip: Clip, dataset: Dataset) -> tuple[Scene, int]:
    """The scene and seed of a clip. Raises BadInput where this version or these packages would render another."""
    if dataset.facts["generator"] != GENERATOR:
        raise BadInput(f"{dataset.path} was rendered by another version: render it again with `onespp dataset`")
    check_versions(dataset)
    profile = profile_of(dataset.facts["profile"])
    if source_of(profile) != dataset.facts.get("source", {}):
        raise BadInput(f"{dataset.path} was rendered from another {profile.own}: render it again with `onespp dataset`")
    return scene_of_clip(clip.path, profile, dataset.facts["seed"])


def rendered(clip: Clip, dataset: Dataset, spp: int, with_buffers: bool) -> Iterator[NoisyFrame]:
    """Noisy frames of `spp` stratified samples, as in a clip such as 000-4spp. Raises BadInput as `scene_of`."""
    scene, seed = scene_of(clip, dataset)
    sampling = Sampling(1, spp, 2, Options(**dataset.facts["options"]))  # the reference is not used
    channels = (*NOISY_CHANNELS, *SAMPLE_BUFFERS.values()) if with_buffers else NOISY_CHANNELS
    for arrays, _ in render_clip(scene, clip.frames, clip.height, clip.width, sampling, seed, channels):
        yield {name: np.nan_to_num(arrays[name][0], nan=0, posinf=0, neginf=0) for name in channels}


def with_samples(clip: Clip, dataset: Dataset, spp: int, root: Path, with_buffers: bool = False) -> Clip:
    """`clip` with `spp` samples per pixel as its noisy input: a clip of one realisation below the folder `root`.

    `with_buffers` adds two sample buffers, if `spp` is an even multiple of the clip's own. The clip is made if missing
    or out of date; its other channels are the files of `clip`. Raises BadInput where `spp` is no multiple of the clip's
    own samples or more than its sampler has, where another process is making it, and as `scene_of`.
    """
    own = clip.facts["noisy_spp"]
    if spp == own:
        return clip
    if Options(**dataset.facts["options"]).halton and spp > CYCLE:
        raise BadInput(
            f"{dataset.path} is of --halton, which has {CYCLE} different samples a pixel: {spp} are too many"
        )
    if spp % own:
        raise BadInput(f"{clip.path} has {own} samples a pixel: {spp} are no multiple of that")
    path = root / clip.path.parent.parent.name / clip.scene / f"{clip.name}-{spp}spp"
    with_buffers = with_buffers and spp // own % 2 == 0
    made_of = {"clip": str(clip.path.resolve()), "crc32": clip.fingerprint, "buffers": with_buffers}
    if (path / "clip.json").exists() and read_json(path / "clip.json").get("made_of") == made_of:
        return Clip(path)
    path.mkdir(parents=True, exist_ok=True)
    with locked(path.with_name(f".{path.name}.lock")) as ours:
        if not ours:
            raise BadInput(f"another process is making {path}: wait for it")
        frames = rendered(clip, dataset, spp, with_buffers)
        progress = tqdm(frames, f"{clip.scene}/{path.name}", clip.frames, unit="frame", leave=False)
        write_resampled(path, clip, list(progress), {"noisy_spp": spp, "made_of": made_of})
    return Clip(path)


def write_resampled(path: Path, clip: Clip, frames: list[NoisyFrame], facts: dict[str, Any]) -> None:
    """Store a copy of `clip` with `frames` as its noisy input and `facts` in its clip.json, which is written last."""
    (path / "clip.json").unlink(missing_ok=True)
    entries = {
        name: entry | {"file": str((clip.path / entry["file"]).resolve())} if "file" in entry else entry
        for name, entry in clip.channels.items()
    }
    for name in frames[0]:
        array = np.stack([frame[name] for frame in frames])[:, None].astype("<f4")
        file = path / f"{name}.npy"
        np.save(file, array)
        entry = {"file": file.name, "dtype": "<f4", "shape": list(array.shape), "unit": CHANNELS[name].unit}
        entries[name] = entry | {"crc32": crc32_of(file)}
    write_json(path / "clip.json", clip.facts | facts | {"channels": entries})


class Cost(NamedTuple):
    """Milliseconds of a frame: a constant part (rays, first hits) and a part per sample."""

    frame_ms: float
    sample_ms: float

    def of(self, spp: int) -> float:
        return self.frame_ms + self.sample_ms * spp


def fit_cost(spp: Sequence[int], ms: Sequence[float]) -> Cost:
    """The line through measured times, by least squares; neither part is below 0."""
    sample_ms, frame_ms = np.polyfit(spp, ms, 1)
    return Cost(max(0.0, float(frame_ms)), max(0.0, float(sample_ms)))


def sample_cost(scene: Scene, height: int, width: int, threads: int, options: Options) -> Cost:
    """The cost of the scene's first frame, without its G-buffer, whose time does not depend on samples."""
    stage = Stage(scene, height, width)
    stage.pose(0)
    ray = stage.rays(stage.view(0))
    tracer = PathTracer(stage, *options)
    seeds = count()  # a different one for every call

    def trace(spp: int) -> None:
        tracer.radiance(ray, next(seeds), spp)

    before = dr.thread_count()
    dr.set_thread_count(threads)
    try:
        work = {f"{spp} spp": partial(trace, spp) for spp in TIMED_SPP}
        seconds = take_turns(work, TIMED_FRAMES_EACH, label="samples")
    finally:
        dr.set_thread_count(before)
    return fit_cost(TIMED_SPP, [1e3 * median(spent) for spent in seconds.values()])
