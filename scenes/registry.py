"""The scenes that have names."""

import re
from collections.abc import Callable

import numpy as np

from errors import BadInput
from scenes.animation import Scene
from scenes.cornell import cornell_box, cornell_box_moving
from scenes.extremes import EXTREMES
from scenes.rooms import room

SCENES: dict[str, Callable[[np.random.Generator, int], Scene]] = {
    "cornell_box": cornell_box,
    "cornell_box_moving": cornell_box_moving,
    **EXTREMES,
}


def build_scene(name: str, seed: int, frames: int) -> Scene:
    """The animated scene `name` with the camera flight and motions that `seed` draws, for a clip of `frames` frames.

    In `room-N` all is drawn from the integer N: every number is another room with its own flight, whatever the seed.
    Deterministic in its arguments. Raises BadInput for a name that is not a scene's.
    """
    number = re.fullmatch(r"room-(-?\d+)", name)
    if number:
        n = int(number[1])
        return room(np.random.default_rng(2 * n if n >= 0 else -2 * n - 1), frames)
    if name not in SCENES:
        raise BadInput(f"unknown scene '{name}'; the scenes are {', '.join(SCENES)} and room-N with any integer N")
    return SCENES[name](np.random.default_rng(seed), frames)
