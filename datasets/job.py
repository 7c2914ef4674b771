"""The generation job: render the clips of a profile that are not there yet."""

import re
import zlib
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from datasets.clip import SCHEMA, SPLITS, Dataset, is_clip
from datasets.files import locked, read_json, write_json
from datasets.writer import ClipWriter
from errors import BadInput
from render.clip import Sampling, render_clip
from scenes import SCENES, build_scene

GENERATOR = 2  # raise it when the same seed renders different bytes


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
    """The content of dataset.json. Raises BadInput for an unknown profile or an unusable seed."""
    if seed < 0:
        raise BadInput(f"the seed {seed} is negative: use 0 or more")
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


def begin(root: Path, wanted: dict[str, Any]) -> None:
    """Write the plan into a new data set's folder, or check that the plan there is the same."""
    if not (root / "dataset.json").exists():
        write_json(root / "dataset.json", wanted)
        return
    present = read_json(root / "dataset.json")
    for key in ("schema", "profile", "seed", "generator", "splits"):
        if present.get(key) != wanted[key]:
            raise BadInput(f"{root} was made with another {key}: choose another --data or delete it")


def check_folder(root: Path) -> None:
    """Raise BadInput for a place that is not a new folder, an empty one or a data set's."""
    if root.exists() and not root.is_dir():
        raise BadInput(f"{root} is a file, not a folder: choose another --data")
    visible = [path.name for path in root.glob("[!.]*")]
    if visible and "dataset.json" not in visible:
        raise BadInput(f"{root} holds something else than a data set: choose an empty or new folder")


def check_versions(dataset: Dataset, here: dict[str, str]) -> None:
    """Raise BadInput where the data set was begun with other packages: the same seed may render other bytes."""
    changed = [
        f"{name} {old}, here {here[name]}" for name, old in dataset.facts["versions"].items() if here[name] != old
    ]
    if changed:
        raise BadInput(f"{dataset.path} was begun with {'; '.join(changed)}: install those or start a new folder")


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


@dataclass(frozen=True)
class Part:
    """Share `index` (from 1) of `count` disjoint ones of a data set's clips."""

    index: int
    count: int

    @staticmethod
    def parse(text: str) -> "Part":
        """From "K/N". Raises BadInput unless 1 <= K <= N."""
        match = re.fullmatch(r"(\d+)/(\d+)", text)
        part = Part(int(match[1]), int(match[2])) if match else Part(0, 0)
        if not 1 <= part.index <= part.count:
            raise BadInput(f"'{text}' is not a part: write K/N with K from 1 to N, such as 2/8")
        return part


def generate(root: Path, profile: str, seed: int, part: Part | None = None) -> int:
    """Render what is missing of `profile`'s data set at `root`, or of one part of it. Returns how many clips were.

    Several jobs may work on one folder, on machines that share it or not: each clip is rendered by one of them, and
    merged folders of disjoint parts are the whole. A clip that fails is left out and the rest goes on.
    Raises BadInput at the end, naming the first clip that failed; OSError at once, for a full disk fills for all.
    """
    wanted = plan(profile, seed)
    check_folder(root)
    root.mkdir(parents=True, exist_ok=True)
    begin(root, wanted)
    dataset = Dataset(root)
    first, step = (part.index - 1, part.count) if part else (0, 1)
    missing = [path for path in dataset.planned()[first::step] if not is_clip(path)]
    if missing:
        check_versions(dataset, wanted["versions"])
    rendered, failed = 0, dict[Path, Exception]()
    for path in tqdm(missing, "clips", unit="clip"):
        split, scene, index = path.parts[-3:]
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path.with_name(f".{path.name}.lock")) as ours:
            if not ours:
                tqdm.write(f"{path}: left to another process, which is rendering it")
            elif not is_clip(path):
                try:
                    render_to(path, scene, DATA_PROFILES[profile], split, clip_seed(seed, scene, split, int(index)))
                    rendered += 1
                except (RuntimeError, ValueError) as error:
                    failed[path] = error
                    tqdm.write(f"{path}: failed, the rest goes on: {error}")
    if failed:
        path, first_error = next(iter(failed.items()))
        raise BadInput(
            f"{len(failed)} of {len(missing)} clips failed and can be tried again, first {path}: {first_error}"
        ) from first_error
    return rendered
