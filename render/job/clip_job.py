"""Rendering one clip into its folder: the unit of work of processes and machines."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from tqdm import tqdm

from datasets.channels import CHANNELS, SECOND_LAYER
from datasets.clip import ClipKind, is_clip
from datasets.writer import ClipWriter
from files import locked
from render.clip import NO_OPTIONS, Options, Sampling, StepTimer, render_clip
from render.job.pilots import samples_needed
from render.job.plan import scene_of_clip
from render.job.profiles import DataProfile, profile_of
from scenes.animation import Scene


class RenderJob(NamedTuple):
    """One clip to render, and everything that determines its bytes."""

    path: Path  # DATA/SPLIT/SCENE/CLIP
    profile: str
    seed: int  # of the dataset
    channels: tuple[str, ...]
    options: Options
    needed_spp: int | None = None  # by its references, if known


class ClipOutcome(NamedTuple):
    path: Path
    ending: Literal["rendered", "left", "failed"]
    reason: str = ""


def run_clip_job(job: RenderJob) -> ClipOutcome:
    """Render a clip unless another process is rendering it or has done so.

    Failures of the renderer are returned. OSError is raised: a full disk concerns all clips.
    """
    job.path.parent.mkdir(parents=True, exist_ok=True)
    with locked(job.path.with_name(f".{job.path.name}.lock")) as ours:
        if not ours:
            return ClipOutcome(job.path, "left", "skipped: another process is rendering it")
        if is_clip(job.path):
            return ClipOutcome(job.path, "left", "skipped: another process has rendered it")
        try:
            render_to_folder(job.path, profile_of(job.profile), job.seed, job.channels, job.options, job.needed_spp)
        except (RuntimeError, ValueError) as error:
            return ClipOutcome(job.path, "failed", str(error))
    return ClipOutcome(job.path, "rendered")


def render_to_folder(
    folder: Path,
    profile: DataProfile,
    dataset_seed: int,
    channels: Sequence[str],
    options: Options = NO_OPTIONS,
    needed_spp: int | None = None,
) -> None:
    """Render channels of the clip in the folder DATA/SPLIT/SCENE/CLIP, completely or not at all.

    By default a pilot predicts `needed_spp`, the samples a pixel that references need. The clip is deterministic in the
    arguments. Raises BadInput for an unknown scene or clip name.
    """
    split, _, clip_name = folder.parts[-3:]
    noisy_spp = ClipKind.of(clip_name).noisy_spp
    quality = profile.quality[split]
    scene, seed = scene_of_clip(folder, profile, dataset_seed)
    clock = StepTimer()
    if needed_spp is None:
        needed_spp = samples_needed(scene, profile.size, quality, seed, options)
        clock.lap("pilot")
    spp = min(needed_spp, max(quality.reference_spp, quality.most_spp))
    sampling = Sampling(quality.realisations, noisy_spp, spp, options)
    layers = SECOND_LAYER if split == "test" else ()  # networks are trained on one layer of glass
    judged = profile.judged if split == "test" else ()
    write_clip(folder, scene, profile.size, sampling, seed, (*channels, *layers), clock.read(), judged)


def write_clip(
    folder: Path,
    scene: Scene,
    size: tuple[int, int, int],
    sampling: Sampling,
    seed: int,
    channels: Sequence[str],
    seconds_before: dict[str, float] | None = None,
    judged: Sequence[int] = (),
) -> None:
    """Render channels of a scene into a clip of `size` (frames, height, width), completely or not at all.

    `seconds_before` rendering, by step, are recorded with those of rendering. `judged`: see render_clip.
    """
    split, scene_name, clip_name = folder.parts[-3:]
    frames = render_clip(scene, *size, sampling, seed, channels, judged)
    derived = {name: "camera" for name in channels if CHANNELS[name].is_camera_motion and not scene.moves()}
    with ClipWriter(folder) as writer:
        writer.timing = dict(seconds_before or {})
        for arrays, seconds in tqdm(frames, f"{split}/{scene_name}/{clip_name}", size[0], leave=False, unit="frame"):
            writer.add(arrays, seconds)
        facts = {
            "noisy_spp": sampling.noisy_spp,
            "reference_spp": sampling.reference_spp // 2 * 2,
            "meshes": [shape.name for shape in scene.meshes],
        }
        writer.finish(facts, derived)
