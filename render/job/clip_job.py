"""Rendering one clip into its folder: the unit of work that processes and machines share."""

from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from datasets.channels import CHANNELS, SECOND_LAYER
from datasets.clip import ClipKind
from datasets.writer import ClipWriter
from render.clip import NO_OPTIONS, Options, Sampling, StepTimer, render_clip
from render.job.pilots import samples_needed
from render.job.plan import scene_of_clip
from render.job.profiles import DataProfile
from scenes.animation import Scene


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
    write_clip(folder, scene, profile.size, sampling, seed, (*channels, *layers), clock.read())


def write_clip(
    folder: Path,
    scene: Scene,
    size: tuple[int, int, int],
    sampling: Sampling,
    seed: int,
    channels: Sequence[str],
    seconds_before: dict[str, float] | None = None,
) -> None:
    """Render channels of a scene into a clip of `size` (frames, height, width), completely or not at all.

    `seconds_before` rendering, by step, are recorded with those of rendering.
    """
    split, scene_name, clip_name = folder.parts[-3:]
    frames = render_clip(scene, *size, sampling, seed, channels)
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
