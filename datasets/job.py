"""The generation job: render the clips of a profile that are not there yet."""

import fcntl
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from datasets.clip import SCHEMA, SPLITS, Dataset
from datasets.files import read_json, write_json
from datasets.writer import ClipWriter
from errors import BadInput
from render.clip import Sampling, render_clip
from scenes import SCENES, build_scene

GENERATOR = 1  # raise it when the same seed renders different bytes


@dataclass(frozen=True)
class DataProfile:
    """How much to render of each scene: image size, clips by split, frames a clip, samples."""

    height: int
    width: int
    frames: int
    clips: dict[str, int]
    train: Sampling
    test: Sampling  # validation and test


DATA_PROFILES = {
    "tiny": DataProfile(
        64, 64, 8, {"train": 1, "val": 1, "test": 1}, train=Sampling(2, 1, 64), test=Sampling(1, 1, 128)
    ),
    "quick": DataProfile(
        128, 128, 24, {"train": 4, "val": 1, "test": 1}, train=Sampling(7, 1, 256), test=Sampling(1, 1, 256)
    ),
}


def clip_seed(seed: int, scene: str, split: str, index: int) -> int:
    """A seed of its own for every clip: independent of which other clips there are and of the order of rendering."""
    words = [seed, zlib.crc32(scene.encode()), zlib.crc32(split.encode()), index]
    return int(np.random.SeedSequence(words).generate_state(1, np.uint64)[0])


def plan(profile: str, seed: int) -> dict[str, Any]:
    """The content of dataset.json. Raises BadInput for an unknown profile."""
    if profile not in DATA_PROFILES:
        raise BadInput(f"unknown profile '{profile}'; the profiles are {', '.join(DATA_PROFILES)}")
    clips = DATA_PROFILES[profile].clips
    return {
        "schema": SCHEMA,
        "profile": profile,
        "generator": GENERATOR,
        "versions": {package: version(package) for package in ("onespp", "mitsuba", "drjit", "numpy")},
        "seed": seed,
        "scenes": list(SCENES),
        "splits": {split: [f"{s}/{i:03d}" for s in SCENES for i in range(clips[split])] for split in SPLITS},
    }


@contextmanager
def only_job(root: Path) -> Iterator[None]:
    """Hold the data set's lock. Raises BadInput where another job is writing there."""
    with (root / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadInput(
                f"another `onespp dataset` is writing to {root}: wait for it or use another folder"
            ) from None
        yield


def begin(root: Path, profile: str, seed: int) -> None:
    """Create the data set's folder and plan, or check that the plan there is the same."""
    wanted = plan(profile, seed)
    if root.exists() and not root.is_dir():
        raise BadInput(f"{root} is a file, not a folder: choose another --data")
    if not (root / "dataset.json").exists():
        if root.exists() and any(path.name != ".lock" for path in root.iterdir()):
            raise BadInput(f"{root} holds something else than a data set: choose an empty or new folder")
        root.mkdir(parents=True, exist_ok=True)
        write_json(root / "dataset.json", wanted)
        return
    present = read_json(root / "dataset.json")
    for key in ("schema", "profile", "seed", "generator", "splits"):
        if present.get(key) != wanted[key]:
            raise BadInput(f"{root} was made with another {key}: choose another --data or delete it")


def render_to(destination: Path, scene_name: str, profile: DataProfile, split: str, seed: int) -> None:
    """Render one clip, whole or not at all. Deterministic in its arguments."""
    scene = build_scene(scene_name, seed, profile.frames)
    sampling = profile.train if split == "train" else profile.test
    frames = render_clip(scene, profile.frames, profile.height, profile.width, sampling, seed)
    label = f"{split}/{scene_name}/{destination.name}"
    with ClipWriter(destination) as writer:
        for channels, seconds in tqdm(frames, label, profile.frames, leave=False, unit="frame"):
            writer.add(channels, seconds)
        facts = {
            "noisy_spp": sampling.noisy_spp,
            "reference_spp": sampling.reference_spp // 2 * 2,
            "meshes": [shape.name for shape in scene.shapes],
        }
        writer.finish(facts, {} if scene.moves() else {"motion": "camera"})


def generate(root: Path, profile: str, seed: int) -> int:
    """Render what is missing of `profile`'s data set at `root`. Returns how many clips were rendered."""
    begin(root, profile, seed)
    with only_job(root):
        missing = [path for path in Dataset(root).planned() if not (path / "clip.json").exists()]
        for path in tqdm(missing, "clips", unit="clip"):
            split, scene, index = path.parts[-3:]
            render_to(path, scene, DATA_PROFILES[profile], split, clip_seed(seed, scene, split, int(index)))
    return len(missing)
