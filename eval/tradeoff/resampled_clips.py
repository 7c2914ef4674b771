"""Clips with more samples per pixel: a dataset's clips with other noisy input, rendered and stored."""

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.channels import CHANNELS, NOISY_CHANNELS, SAMPLE_BUFFERS
from datasets.clip import Clip, Dataset
from errors import BadInput
from files import locked, read_json, write_json
from render.clip import Options, Sampling, render_clip
from render.job.generate import check_versions
from render.job.plan import GENERATOR, scene_of_clip
from render.job.profiles import profile_of, source_of
from render.sampler import CYCLE
from scenes.animation import Scene

NoisyFrame = dict[str, NDArray[np.floating]]  # of each of NOISY_CHANNELS (H, W, 3), of SAMPLE_BUFFERS (2, H, W, 3)


def scene_of(clip: Clip, dataset: Dataset) -> tuple[Scene, int]:
    """The scene and the seed of a clip.

    Raises BadInput where this version or other packages would render it differently.
    """
    if dataset.facts["generator"] != GENERATOR:
        raise BadInput(f"{dataset.path} was rendered by another version: render it again with `onespp dataset`")
    check_versions(dataset)
    profile = profile_of(dataset.facts["profile"])
    if source_of(profile) != dataset.facts.get("source", {}):
        raise BadInput(f"{dataset.path} was rendered from another {profile.own}: render it again with `onespp dataset`")
    return scene_of_clip(clip.path, profile, dataset.facts["seed"])


def rendered(clip: Clip, dataset: Dataset, spp: int, with_buffers: bool) -> Iterator[NoisyFrame]:
    """Noisy frames rendered with `spp` stratified samples, the same as those of a clip such as 000-4spp.

    Raises BadInput as `scene_of`.
    """
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
        crc32 = f"{zlib.crc32(file.read_bytes()):08x}"
        entries[name] = {
            "file": file.name,
            "dtype": "<f4",
            "shape": list(array.shape),
            "unit": CHANNELS[name].unit,
            "crc32": crc32,
        }
    write_json(path / "clip.json", clip.facts | facts | {"channels": entries})
