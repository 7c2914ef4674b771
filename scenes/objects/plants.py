"""Potted plants, for the floor and for supports."""

import math

import numpy as np
from numpy.typing import ArrayLike

from scenes.camera import Array
from scenes.draws import Rng, uniforms
from scenes.meshes import disc, hollow, lathe, leaf, silhouette, tube
from scenes.objects.thing import SurfacesBySlot, Thing, standing


def arc(rng: Rng, start: ArrayLike, length: float, azimuth: float, droop: float, count: int = 8) -> Array:
    """A path (count, 3) in the vertical plane of `azimuth` that rises from `start` and bends down, above y = 0."""
    t = np.linspace(0, 1, count)
    out = rng.uniform(0.4, 0.8) * t
    up = 0.9 * t - droop * t**2
    bent = np.stack([math.cos(azimuth) * out, up, math.sin(azimuth) * out], axis=1) * length + np.asarray(start)
    return np.maximum(bent, (-np.inf, 0.01, -np.inf))


def tuft(rng: Rng, start: float, size: float) -> SurfacesBySlot:
    """Long leaves that grow out of (0, `start`, 0), about `size` long."""
    paths = [
        arc(rng, (0, start, 0), size * rng.uniform(0.5, 0.9), azimuth, rng.uniform(0.1, 1.2))
        for azimuth in rng.uniform(0, 2 * np.pi, rng.integers(14, 36))
    ]
    width = size * rng.uniform(0.03, 0.09)
    fold = rng.uniform(0, 0.6)
    return {"leaf": [leaf(path, width, fold) for path in paths]}


def shrub(rng: Rng, start: float, size: float) -> SurfacesBySlot:
    """Stems with many leaves that grow out of (0, `start`, 0), about `size` tall."""
    surfaces: SurfacesBySlot = {"stem": [], "leaf": []}
    length = size * rng.uniform(0.15, 0.35)
    ratio, fold = uniforms(rng, (0.3, 0.8), (0, 0.5))
    for azimuth in rng.uniform(0, 2 * np.pi, rng.integers(2, 7)):
        tall = size * rng.uniform(0.6, 1.0)
        lean = np.linspace(0, 1, 8)[:, None] ** 2 * rng.uniform(0.05, 0.35) * tall
        path = np.array([0, start, 0]) + lean * (math.cos(azimuth), 0, math.sin(azimuth))
        path[:, 1] += np.linspace(0, tall, 8)
        surfaces["stem"].append(tube(path, np.linspace(0.012, 0.005, 8) * size, 6))
        for k in rng.integers(2, 8, 14):
            reach = length * rng.uniform(0.7, 1.2)
            towards, droop = uniforms(rng, (0, 2 * np.pi), (0.2, 1.2))
            surfaces["leaf"].append(leaf(arc(rng, path[k], reach, towards, droop, 6), length * ratio, fold))
    return surfaces


def potted(rng: Rng, name: str, radius: float, height: float) -> Thing:
    """A plant in a pot of about `radius`, about `height` tall in all."""
    deep = min(radius * rng.uniform(1.2, 2.0), height / 2)
    wall = radius * 0.08
    level = deep * 0.85
    outer = silhouette(np.sort(rng.uniform(0.65, 1.0, 3)) * radius, deep, 12)
    soil = disc(float(np.interp(level, outer[:, 1], outer[:, 0])) - wall / 2, 0.02 * deep, 24).at(0, level)
    pot: SurfacesBySlot = {"ceramic": [lathe(hollow(outer, wall, deep * 0.8), 28)], "soil": [soil]}
    grow = tuft if rng.random() < 0.4 else shrub
    return standing(name, pot, grow(rng, level, height - level))


def make_floor_plant(rng: Rng) -> Thing:
    return potted(rng, "floor_plant", rng.uniform(0.1, 0.22), rng.uniform(0.7, 1.7))


def make_small_plant(rng: Rng) -> Thing:
    return potted(rng, "small_plant", rng.uniform(0.03, 0.07), rng.uniform(0.14, 0.42))
