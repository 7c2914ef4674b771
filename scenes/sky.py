"""Skies as environment maps, and the sun."""

import numpy as np

from scenes.camera import Array
from scenes.colours import light_colour
from scenes.draws import Rng, log_uniform

SKY_SIZE = (64, 128)  # rows and columns; kernels of scenes with skies of the same size are shared


def sky(rng: Rng, sun: Array | None) -> Array:
    """Radiance (*SKY_SIZE, 3) of a sky over dark ground: latitude-longitude, y up.

    `sun` is the direction (3,) to the sun, or None under clouds. The sun gives 0.3 to 30 times the light of its sky.
    """
    height, width = SKY_SIZE
    up = np.cos(np.pi * ((np.arange(height) + 0.5) / height))[:, None, None]
    zenith = rng.uniform(0.6, 1.0, 3) * [0.4, 0.6, 1.0]
    horizon = rng.uniform(0.6, 1.0, 3) * [0.9, 0.95, 1.0]
    ground = rng.uniform(0.5, 1.0, 3) * 0.2
    blend = np.clip(up, 0, 1) ** 0.5
    image = np.where(up > 0, zenith * blend + horizon * (1 - blend), ground)
    image = np.repeat(image, width, axis=1)
    if sun is not None:
        x, y, z = sun / np.linalg.norm(sun)
        row = np.arccos(y) / np.pi * height
        column = np.arctan2(x, -z) / np.pi / 2 % 1 * width
        image[int(row), int(column)] += light_colour(rng) * log_uniform(rng, 300, 20000)
    return np.asarray(image)
