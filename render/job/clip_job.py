"""Rendering one clip into its folder: the unit of work that processes and machines share out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from tqdm import tqdm

from datasets.clip import is_clip
from datasets.clip_kind import ClipKind
from datasets.writer import ClipWriter
from files import locked
from render.clip import NO_OPTIONS, Options, Sampling, StepTimer, render_clip
from render.job.adaptive_spp import samples_needed
from render.job.clip_scene import scene_of_clip
from render.job.profiles import DataProfile, profile_of
from scenes.animation import Scene


class RenderJob(NamedTuple):
    """One clip to render, and everything that its bytes follow from."""

    path: Path  # DATA/SPLIT/SCENE/CLIP
    profile: str
    seed: int  # of the data set
    channels: tuple[str, ...]
    options: Options
    needed_spp: int | None = None  # by its references, where that is known


class ClipOutcome(NamedTuple):
    """How a clip's job ended, with the reason where it did not render the clip."""

    path: Path
    ending: Literal["rendered", "left", "failed"]
    reason: str = ""


def run_clip_job(job: RenderJob) -> ClipOutcome:
    """Render a clip unless another process is rendering it or has done so.

    A failure of the renderer is an outcome. OSError is raised instead: a full disk is full for all clips.
    """
    job.path.parent.mkdir(parents=True, exist_ok=True)
    with locked(job.path.with_name(f".{job.path.name}.lock")) as ours:
        if not ours:
            return ClipOutcome(job.path, "left", "left to another process, which is rendering it")
        if is_clip(job.path):
            return ClipOutcome(job.path, "left", "another process has rendered it")
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
    """Render the named channels of the clip whose folder is DATA/SPLIT/SCENE/CLIP, whole or not at all.

    Where `needed_spp` is not known yet, a pilot finds out how many samples a pixel the references need.

    The clip is a function of the arguments alone. Raises BadInput for an unknown scene or clip name.
    """
    split, _, clip_name = folder.parts[-3:]
    noisy_spp = ClipKind.of(clip_name).noisy_spp
    quality = profile.quality[split]
    scene, seed = scene_of_clip(folder, profile, dataset_seed)
    clock = StepTimer()
    if needed_spp is None:
        needed_spp = samples_needed(scene, profile.frames, profile.height, profile.width, quality, seed, options)
        clock.lap("pilot")
    spp = min(needed_spp, max(quality.reference_spp, quality.most_spp))
    size = (profile.frames, profile.height, profile.width)
    write_clip(
        folder, scene, size, Sampling(quality.realisations, noisy_spp, spp, options), seed, channels, clock.read()
    )


def write_clip(
    folder: Path,
    scene: Scene,
    size: tuple[int, int, int],
    sampling: Sampling,
    seed: int,
    channels: Sequence[str],
    seconds_before: dict[str, float] | None = None,
) -> None:
    """Render the named channels of a scene into a clip of `size` (frames, height, width), whole or not at all.

    `seconds_before` rendering, by step, are written down beside those of rendering.
    """
    split, scene_name, clip_name = folder.parts[-3:]
    frames = render_clip(scene, *size, sampling, seed, channels)
    # While only the camera moves, motion follows from depth, and shadows stay on their surfaces.
    alike = () if scene.moves() else ("motion", "shadow_motion")
    derived = {name: "camera" for name in alike if name in channels}
    with ClipWriter(folder) as writer:
        writer.timing = dict(seconds_before or {})
        progress = tqdm(frames, f"{split}/{scene_name}/{clip_name}", size[0], leave=False, unit="frame")
        for arrays, seconds in progress:
            writer.add(arrays, seconds)
        facts = {
            "noisy_spp": sampling.noisy_spp,
            "reference_spp": sampling.reference_spp // 2 * 2,
            "meshes": [shape.name for shape in scene.meshes],
        }
        writer.finish(facts, derived)
