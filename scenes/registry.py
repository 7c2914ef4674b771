"""Scenes by name."""

import re

import numpy as np

from errors import BadInput
from scenes.animation import Scene
from scenes.closeup import closeup
from scenes.cornell import cornell_box, cornell_box_moving
from scenes.extremes import EXTREME_SCENES, SceneBuilder
from scenes.rooms import room

SCENES: dict[str, SceneBuilder] = {
    "cornell_box": cornell_box,
    "cornell_box_moving": cornell_box_moving,
    **EXTREME_SCENES,
}


def build_scene(name: str, seed: int, frames: int) -> Scene:
    """The animated scene `name` for a clip of `frames` frames, with the camera flight and motions that `seed` draws.

    The name is one of SCENES, or `room-N` or `closeup-N` with any integer N. Every number is another room with its own
    flight, whatever the seed. The same arguments give the same scene. Raises BadInput for other names.
    """
    number = re.fullmatch(r"(room|closeup)-(-?\d+)", name)
    if number:
        n = int(number[2])
        build = room if number[1] == "room" else closeup
        return build(np.random.default_rng(2 * n if n >= 0 else -2 * n - 1), frames)
    if name not in SCENES:
        raise BadInput(
            f"unknown scene '{name}'; the scenes are {', '.join(SCENES)}, room-N and closeup-N with any integer N"
        )
    return SCENES[name](np.random.default_rng(seed), frames)
