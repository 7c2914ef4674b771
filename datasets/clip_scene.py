"""The scene of a clip, by the clip's place in a data set."""

from pathlib import Path

from datasets.clip_kind import ClipKind
from datasets.profiles import clip_seed
from scenes.animation import Scene
from scenes.registry import build_scene


def scene_of_clip(place: Path, frames: int, dataset_seed: int) -> tuple[Scene, int]:
    """The scene, of so many frames, of the clip whose place ends in SPLIT/SCENE/CLIP, and the clip's seed.

    Raises BadInput for an unknown scene or clip name.
    """
    split, scene_name, clip_name = place.parts[-3:]
    kind = ClipKind.of(clip_name)
    seed = clip_seed(dataset_seed, scene_name, split, kind.number)
    scene = build_scene(scene_name, seed, frames)
    return (scene.still() if kind.still else scene), seed
