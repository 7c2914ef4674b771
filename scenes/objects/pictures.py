"""Framed prints, for walls and for supports."""

import math

import numpy as np

from scenes.draws import Rng
from scenes.meshes import sheet, slab, tube
from scenes.objects.furniture_parts import rim
from scenes.objects.thing import SurfacesBySlot, Thing, assembled, merged, shifted, standing


def framed(rng: Rng, width: float, height: float) -> SurfacesBySlot:
    """A picture in a frame, standing on the origin, its back at z = 0, facing +z."""
    border = rng.uniform(0.04, 0.12) * min(width, height)
    depth = rng.uniform(0.012, 0.035)
    frame = [slab(width - border, height - border, depth * 0.5).at(0, border / 2), *rim(width, height, border, depth)]
    right = width / 2 - border
    bottom = border
    top = height - border
    corners = np.array([[(-right, bottom), (right, bottom)], [(-right, top), (right, top)]])
    uv = np.array([[(0.0, 0.0), (1.0, 0.0)], [(0.0, 1.0), (1.0, 1.0)]])
    # The print lies just before the board behind it.
    panel = sheet(np.concatenate([corners, np.full((2, 2, 1), depth * 0.25 + 0.001)], axis=2), uv)
    return shifted({"frame": frame, "print": [panel]}, z=depth / 2)


def make_photo(rng: Rng) -> Thing:
    """A small picture that leans back on its prop."""
    width = rng.uniform(0.09, 0.22)
    height = rng.uniform(0.12, 0.28)
    lean = rng.uniform(0.12, 0.3)
    picture = framed(rng, width, height)
    leaning = {slot: [surface.turned(-lean, axis=0) for surface in surfaces] for slot, surfaces in picture.items()}
    reach = height * 0.7
    prop = tube([(0, reach * math.cos(lean), -reach * math.sin(lean)), (0, 0, -height * 0.4)], 0.004, 6)
    return standing("photo", merged(leaning, {"metal": [prop]}))


def make_picture(rng: Rng) -> Thing:
    """A framed print for a wall: its back at z = 0, facing +z."""
    return assembled("picture", framed(rng, rng.uniform(0.25, 1.2), rng.uniform(0.25, 1.0)))
