"""Scenes by name."""

import re

import numpy as np

from errors import BadInput
from scenes.animation import Scene
from scenes.cornell import EXTREME_SCENES, SceneBuilder, cornell_box, cornell_box_moving
from scenes.glass import GLASS_SCENES
from scenes.rooms import closeup, room

SCENES: dict[str, SceneBuilder] = {
    "cornell_box": cornell_box,
    "cornell_box_moving": cornell_box_moving,
    **EXTREME_SCENES,
    **GLASS_SCENES,
}


def build_scene(name: str, seed: int, frames: int) -> Scene:
    """The animated scene `name` for a clip of `frames` frames, with the camera flight and motions of `seed`.

    The name is one of SCENES, or `room-N` or `closeup-N` with any integer N, whose scenes depend on N instead of
    `seed`. Raises BadInput for other names.
    """
    number = re.fullmatch(r"(room|closeup)-(-?\d+)", name)
    if number:
        n = int(number[2])
        rng = np.random.default_rng(2 * n if n >= 0 else -2 * n - 1)
        return room(rng, frames) if number[1] == "room" else closeup(rng, frames)
    if name not in SCENES:
        names = f"{', '.join(SCENES)}, room-N and closeup-N with any integer N"
        raise BadInput(f"unknown scene '{name}'; the scenes are {names}")
    return SCENES[name](np.random.default_rng(seed), frames)
