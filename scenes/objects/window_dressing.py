"""Blinds and curtains, which hang before windows."""

import numpy as np

from scenes.draws import Rng
from scenes.meshes import sheet, slab
from scenes.objects.thing import Thing, assembled


def make_blind(rng: Rng, width: float, height: float) -> Thing:
    """Thin tilted slats that fill a window `width` x `height` about the xy plane, with a rail and cords."""
    depth = rng.uniform(0.025, 0.05)
    pitch = rng.uniform(0.035, 0.055)
    levels = np.linspace(depth / 2, height - 0.03 - depth / 2, max(2, round(height / pitch)))
    slat = slab(width, 0.0015, depth).turned(rng.uniform(-1.2, 1.2), axis=0)
    slats = [slat.at(0, y) for y in levels]
    cord = slab(0.002, height, 0.002)
    rail = slab(width, 0.03, 0.04).at(0, height - 0.03)
    return assembled("blind", {"slat": slats, "metal": [rail, cord.at(-width / 3), cord.at(width / 3)]})


def make_curtain(rng: Rng, width: float, height: float) -> Thing:
    """A wavy sheet of cloth `width` x `height` about the xy plane; its waves grow and drift downwards."""
    waves = max(2, round(width / rng.uniform(0.09, 0.2)))
    columns = 16 * waves + 1
    rows = 5
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, columns), np.linspace(0, height, rows))
    down = 1 - y / height
    knots = np.arange(0, columns, 16)
    uneven = np.interp(np.arange(columns), knots, rng.normal(0, 1, waves + 1))
    late = np.interp(np.arange(columns), knots, rng.normal(0, 1, waves + 1))
    size = width / waves * rng.uniform(0.2, 0.4) * (0.5 + 0.5 * down) * np.exp(0.2 * uneven)
    z = size * np.sin(2 * np.pi * waves * x / width + 0.4 * late + rng.uniform(-1, 1) * down)
    along = np.cumsum(np.hypot(np.gradient(x[-1]), np.gradient(z[-1])))
    uv = np.stack([np.broadcast_to(along, x.shape), y], axis=2)
    return assembled("curtain", {"fabric": [sheet(np.stack([x, y, z], axis=2), uv)]})
