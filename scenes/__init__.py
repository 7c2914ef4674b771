"""What is in front of the camera: animated scenes as plain data."""

from collections.abc import Callable

import numpy as np

from errors import BadInput
from scenes.animation import Scene
from scenes.cornell import cornell_box, cornell_box_moving

SCENES: dict[str, Callable[[np.random.Generator, int], Scene]] = {
    "cornell_box": cornell_box,
    "cornell_box_moving": cornell_box_moving,
}


def build_scene(name: str, seed: int, frames: int) -> Scene:
    """The animated scene `name` with the camera flight and motions that `seed` draws, for a clip of `frames` frames.

    Deterministic in its arguments. Raises BadInput for a name that is not in SCENES.
    """
    if name not in SCENES:
        raise BadInput(f"unknown scene '{name}'; the scenes are {', '.join(SCENES)}")
    return SCENES[name](np.random.default_rng(seed), frames)
