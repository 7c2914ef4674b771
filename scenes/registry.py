"""Scenes by name."""

import re
from pathlib import Path

import numpy as np

from errors import BadInput
from scenes.animation import Scene
from scenes.cornell import EXTREME_SCENES, SceneBuilder, cornell_box, cornell_box_moving
from scenes.furnishing import stock_of
from scenes.glass import GLASS_SCENES
from scenes.rooms import closeup, room

SCENES: dict[str, SceneBuilder] = {
    "cornell_box": cornell_box,
    "cornell_box_moving": cornell_box_moving,
    **EXTREME_SCENES,
    **GLASS_SCENES,
}


def build_scene(name: str, seed: int, frames: int, models: Path | None = None) -> Scene:
    """The animated scene `name` for a clip of `frames` frames, with the camera flight and motions of `seed`.

    The name is one of SCENES, or `room-N` or `closeup-N` with any integer N, whose scenes depend on N instead of
    `seed`; with `furnished-` before it, from the furniture libraries in the folder `models`. Raises BadInput for other
    names, and without such libraries.
    """
    number = re.fullmatch(r"(furnished-)?(room|closeup)-(-?\d+)", name)
    if number:
        if number[1] and models is None:
            raise BadInput(f"scene '{name}' needs --models, the folder of the furniture libraries")
        n = int(number[3])
        rng = np.random.default_rng(2 * n if n >= 0 else -2 * n - 1)
        stock = stock_of(models if number[1] else None)
        return (room if number[2] == "room" else closeup)(rng, frames, stock)
    if name not in SCENES:
        names = f"{', '.join(SCENES)}, room-N and closeup-N with any integer N"
        raise BadInput(f"unknown scene '{name}'; the scenes are {names}")
    return SCENES[name](np.random.default_rng(seed), frames)
