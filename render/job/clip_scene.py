"""The scene of a clip, by the clip's place in a data set."""

from pathlib import Path

from datasets.clip_kind import ClipKind
from render.job.profiles import DataProfile, clip_seed
from render.scene_file.load import own_scene
from scenes.animation import Scene
from scenes.description import Split
from scenes.registry import build_scene


def scene_of_clip(place: Path, profile: DataProfile, dataset_seed: int) -> tuple[Scene, int]:
    """The scene of the clip whose place ends in SPLIT/SCENE/CLIP, and the clip's seed.

    Raises BadInput for an unknown scene or clip name, or a file of a user's own scene that cannot be used.
    """
    split, scene_name, clip_name = place.parts[-3:]
    kind = ClipKind.of(clip_name)
    seed = clip_seed(dataset_seed, scene_name, split, kind.number)
    if profile.own is None:
        scene = build_scene(scene_name, seed, profile.frames)
    else:
        scene = clip_of_own_scene(profile.own, split, kind.number, profile.frames, seed)
    return (scene.still() if kind.still else scene), seed


def clip_of_own_scene(path: Path, split: str, number: int, frames: int, seed: int) -> Scene:
    """A clip of the scene that a TOML describes; the first one for tests begins with the file's own view."""
    own = own_scene(path)
    camera = own.described.splits.get(split, Split()).camera
    by_keyframes = camera == "keyframes" or (camera is None and bool(own.described.camera))
    return own.clip(frames, seed, by_keyframes, from_here=split == "test" and number == 0)
