"""Clips that studies render and store."""

import zlib
from collections.abc import Callable, Sequence
from pathlib import Path

from datasets.clip import Clip, is_clip
from render.clip import Sampling
from render.job.clip_job import write_clip
from render.job.plan import GENERATOR
from scenes.animation import Scene

SEED = 0


def own_clip(
    folder: Path,
    name: str,
    scene: Callable[[], Scene],
    size: tuple[int, int, int],
    sampling: Sampling,
    channels: Sequence[str],
    made_of: object = None,
) -> Clip:
    """The clip `name` of a scene, of `size` (frames, height, width), rendered if missing.

    The name of its folder is a digest of everything that determines it; `made_of` describes the scene beside its name.
    """
    digest = zlib.crc32(repr((GENERATOR, name, SEED, size, sampling, *channels, made_of)).encode())
    path = folder / f"{digest:08x}" / name / "000"
    if not is_clip(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_clip(path, scene(), size, sampling, SEED, channels)
    return Clip(path)
