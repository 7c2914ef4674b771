"""Bodies of lamps, without their lights; see scenes.lighting."""

import numpy as np

from scenes.draws import Rng
from scenes.meshes import disc, lathe, silhouette, superellipsoid, tube
from scenes.objects.thing import Thing, assembled, standing


def make_floor_lamp(rng: Rng) -> Thing:
    """A straight or bent stand with an open shade."""
    height = rng.uniform(1.2, 1.7)
    bow = rng.uniform(0, 0.35) * (rng.random() < 0.5)
    t = np.linspace(0, 1, 12)
    path = np.stack([bow * t**3, 0.02 + (height - 0.12) * t, 0 * t], axis=1)
    radius = rng.uniform(0.12, 0.24)
    tall = rng.uniform(0.18, 0.32)
    shade = lathe([(radius, 0), (radius * rng.uniform(0.4, 1.0), tall)], 36).at(bow, height - tall)
    metal = [disc(rng.uniform(0.12, 0.18), 0.025), tube(path, rng.uniform(0.008, 0.016))]
    return standing("floor_lamp", {"metal": metal, "shade": [shade]})


def make_pendant(rng: Rng) -> Thing:
    """A shade on a cord that hangs from a ceiling: a whole ball, a cone or a bell open below."""
    radius = rng.uniform(0.1, 0.25)
    tall = rng.uniform(0.12, 0.3)
    cord = rng.uniform(0.2, 0.6)
    kind = rng.integers(3)
    if kind == 0:
        tall = 2 * radius
        shade = superellipsoid(tall, tall, tall, 2, 3)
    elif kind == 1:
        shade = lathe([(radius, 0), (radius * rng.uniform(0.1, 0.9), tall)], 36)
    else:
        shade = lathe(silhouette([radius, radius * rng.uniform(0.8, 1.0), radius * 0.7, 0.03], tall, 16), 36)
    line = tube([(0, tall - 0.03, 0), (0, tall + cord, 0)], 0.003, 6)
    return assembled("pendant", {"shade": [shade], "metal": [line]})
