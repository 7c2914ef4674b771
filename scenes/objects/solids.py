"""Plain bodies of any material: boxes, balls, rings, lumps and crystals."""

import numpy as np

from scenes.draws import Rng
from scenes.meshes import blob, circle, gem, lathe, slab, superellipsoid
from scenes.objects.thing import Thing, standing


def make_box(rng: Rng) -> Thing:
    """A chest with a lid, or a bare block."""
    width = rng.uniform(0.06, 0.35)
    height = rng.uniform(0.05, 0.3)
    depth = rng.uniform(0.06, 0.3)
    body = slab(width, height, depth)
    if rng.random() < 0.5:
        return standing("box", {"body": [body]})
    lid = slab(width + 0.008, height * rng.uniform(0.1, 0.3), depth + 0.008).at(0, height)
    return standing("box", {"body": [body], "front": [lid]})


def make_ball(rng: Rng) -> Thing:
    """A sphere."""
    size = rng.uniform(0.06, 0.3)
    return standing("ball", {"body": [superellipsoid(size, size, size, 2, 3)]})


def make_ring(rng: Rng) -> Thing:
    """A torus, upright or lying."""
    radius = rng.uniform(0.04, 0.15)
    torus = lathe(circle(radius, radius * rng.uniform(0.1, 0.45), 16), 48)
    return standing("ring", {"body": [torus.turned(np.pi / 2 * rng.integers(2), axis=0)]})


def make_lump(rng: Rng) -> Thing:
    """A smooth irregular body."""
    subdivisions = int(rng.integers(3, 5))
    return standing("lump", {"body": [blob(rng, rng.uniform(0.05, 0.16), rng.uniform(0.05, 0.3), subdivisions)]})


def make_crystal(rng: Rng) -> Thing:
    """A body with flat facets."""
    return standing("crystal", {"body": [gem(rng, rng.uniform(0.04, 0.16), int(rng.integers(2)))]})
