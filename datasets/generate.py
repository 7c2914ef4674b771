"""The generation job: render the clips of a profile that are not there yet."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from tqdm import tqdm

from datasets.adaptive_spp import reference_spp
from datasets.channels import CHANNELS
from datasets.clip import Dataset, is_clip
from datasets.clip_kind import ClipKind
from datasets.profiles import DataProfile, clip_seed, plan, profile_of, versions
from datasets.writer import ClipWriter
from errors import BadInput
from files import locked, read_json, write_json
from render.clip import NO_OPTIONS, Options, Sampling, StepTimer, render_clip
from scenes.registry import build_scene


def begin(root: Path, wanted: dict[str, Any]) -> None:
    """Write the plan into a new data set's folder, or check that the plan there is the same."""
    if not (root / "dataset.json").exists():
        write_json(root / "dataset.json", wanted)
        return
    present = read_json(root / "dataset.json")
    for key in ("schema", "profile", "seed", "generator", "splits", "channels", "options"):
        if present.get(key) != wanted[key]:
            raise BadInput(f"{root} was made with another {key}: choose another --data or delete it")


def check_folder(root: Path) -> None:
    """Raise BadInput for a place that is not a new folder, an empty one or a data set's."""
    if root.exists() and not root.is_dir():
        raise BadInput(f"{root} is a file, not a folder: choose another --data")
    visible = [path.name for path in root.glob("[!.]*")]
    if visible and "dataset.json" not in visible:
        raise BadInput(f"{root} holds something else than a data set: choose an empty or new folder")


def check_versions(dataset: Dataset) -> None:
    """Raise BadInput where the data set was begun with other packages: the same seed may render other bytes."""
    here = versions()
    changed = [
        f"{name} {old}, here {here[name]}" for name, old in dataset.facts["versions"].items() if here[name] != old
    ]
    if changed:
        raise BadInput(f"{dataset.path} was begun with {'; '.join(changed)}: install those or start a new folder")


def render_to(
    destination: Path, profile: DataProfile, seed: int, channels: Sequence[str], options: Options = NO_OPTIONS
) -> None:
    """Render the clip DATA/SPLIT/SCENE/CLIP, whole or not at all, with the named channels. `seed` is the data set's.

    Deterministic in its arguments.
    """
    split, scene_name, name = destination.parts[-3:]
    kind, quality = ClipKind.of(name), profile.quality[split]
    seed = clip_seed(seed, scene_name, split, kind.number)
    scene = build_scene(scene_name, seed, profile.frames)
    scene = scene.still() if kind.still else scene
    size = profile.frames, profile.height, profile.width
    timer = StepTimer()
    spp = reference_spp(scene, *size, quality, seed, options)
    timer.lap("pilot")
    frames = render_clip(scene, *size, Sampling(quality.realisations, kind.noisy_spp, spp, options), seed, channels)
    with ClipWriter(destination) as writer:
        writer.timing = timer.read()
        for arrays, seconds in tqdm(frames, f"{split}/{scene_name}/{name}", profile.frames, leave=False, unit="frame"):
            writer.add(arrays, seconds)
        facts = {
            "noisy_spp": kind.noisy_spp,
            "reference_spp": spp // 2 * 2,
            "meshes": [shape.name for shape in scene.shapes],
        }
        writer.finish(facts, {} if scene.moves() or "motion" not in channels else {"motion": "camera"})


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


class ClipJob(NamedTuple):
    """One clip to render, and all that its bytes follow from."""

    path: Path  # DATA/SPLIT/SCENE/CLIP
    profile: str
    seed: int  # of the data set
    channels: tuple[str, ...]
    options: Options


class Outcome(NamedTuple):
    """How a clip's job ended, and for what reason where it did not render the clip."""

    path: Path
    ending: Literal["rendered", "left", "failed"]
    reason: str = ""


def render_clip_job(job: ClipJob) -> Outcome:
    """Render a clip, unless another process renders it or has done so.

    A failure of the renderer is an outcome; OSError is raised, for a disk that is full is full for all clips.
    """
    job.path.parent.mkdir(parents=True, exist_ok=True)
    with locked(job.path.with_name(f".{job.path.name}.lock")) as ours:
        if not ours:
            return Outcome(job.path, "left", "left to another process, which is rendering it")
        if is_clip(job.path):
            return Outcome(job.path, "left", "another process has rendered it")
        try:
            render_to(job.path, profile_of(job.profile), job.seed, job.channels, job.options)
        except (RuntimeError, ValueError) as error:
            return Outcome(job.path, "failed", str(error))
    return Outcome(job.path, "rendered")


def render_here(jobs: Sequence[ClipJob]) -> Iterator[Outcome]:
    """Render clips in this process, one after the other."""
    return map(render_clip_job, jobs)


def generate(
    root: Path,
    profile: str,
    seed: int,
    part: Part | None = None,
    reads: Sequence[str] = tuple(CHANNELS),
    options: Options = NO_OPTIONS,
    render: Callable[[Sequence[ClipJob]], Iterator[Outcome]] = render_here,
) -> int:
    """Render what is missing of `profile`'s data set at `root`, or of one part of it. Returns how many clips were.

    Clips for training have the channels in `reads` and those that are always needed.

    Several jobs may work on one folder, on machines that share it or not: each clip is rendered by one of them, and
    merged folders of disjoint parts are the whole. A clip that fails is left out and the rest goes on.
    Raises BadInput at the end, naming the first clip that failed; OSError at once, for a full disk fills for all.
    """
    wanted = plan(profile, seed, reads, options)
    check_folder(root)
    root.mkdir(parents=True, exist_ok=True)
    begin(root, wanted)
    dataset = Dataset(root)
    first, step = (part.index - 1, part.count) if part else (0, 1)
    jobs = [
        ClipJob(path, profile, seed, tuple(wanted["channels"][path.parts[-3]]), options)
        for path in dataset.planned()[first::step]
        if not is_clip(path)
    ]
    if not jobs:
        return 0
    check_versions(dataset)
    ended: dict[str, list[Outcome]] = {"rendered": [], "left": [], "failed": []}
    for outcome in tqdm(render(jobs), "clips", len(jobs), unit="clip"):
        ended[outcome.ending].append(outcome)
        if outcome.ending == "left":
            tqdm.write(f"{outcome.path}: {outcome.reason}")
        elif outcome.ending == "failed":
            tqdm.write(f"{outcome.path}: failed, the rest goes on: {outcome.reason}")
    if ended["failed"]:
        first_failed = ended["failed"][0]
        raise BadInput(
            f"{len(ended['failed'])} of {len(jobs)} clips failed and can be tried again, "
            f"first {first_failed.path}: {first_failed.reason}"
        )
    return len(ended["rendered"])
