"""What hangs: pictures (and photos that stand), mirrors, blinds, curtains, and the bodies of lamps."""

import math

import numpy as np

from scenes.draws import Rng, uniforms
from scenes.meshes import disc, lathe, sheet, silhouette, slab, superellipsoid, tube
from scenes.objects.furniture import EDGE, rim
from scenes.objects.thing import SurfacesBySlot, Thing, assembled, shifted, standing


def make_floor_lamp(rng: Rng) -> Thing:
    """A straight or bent stand with an open shade."""
    height = rng.uniform(1.2, 1.7)
    bow = rng.uniform(0, 0.35) * (rng.random() < 0.5)
    t = np.linspace(0, 1, 12)
    path = np.stack([bow * t**3, 0.02 + (height - 0.12) * t, 0 * t], axis=1)
    radius, tall = uniforms(rng, (0.12, 0.24), (0.18, 0.32))
    shade = lathe([(radius, 0), (radius * rng.uniform(0.4, 1.0), tall)], 36).at(bow, height - tall)
    metal = [disc(rng.uniform(0.12, 0.18), 0.025), tube(path, rng.uniform(0.008, 0.016))]
    return standing("floor_lamp", {"metal": metal, "shade": [shade]})


def make_pendant(rng: Rng) -> Thing:
    """A shade on a cord: a closed ball, a cone or a bell open below."""
    radius, tall, cord = uniforms(rng, (0.1, 0.25), (0.12, 0.3), (0.2, 0.6))
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


def framed(rng: Rng, width: float, height: float) -> SurfacesBySlot:
    """A picture in a frame, standing on the origin, its back at z = 0, facing +z."""
    border = rng.uniform(0.04, 0.12) * min(width, height)
    depth = rng.uniform(0.012, 0.035)
    frame = [slab(width - border, height - border, depth * 0.5).at(0, border / 2), *rim(width, height, border, depth)]
    right, top = width / 2 - border, height - border
    corners = np.array([[(-right, border), (right, border)], [(-right, top), (right, top)]])
    uv = np.array([[(0.0, 0.0), (1.0, 0.0)], [(0.0, 1.0), (1.0, 1.0)]])
    # The print is just in front of its board.
    panel = sheet(np.concatenate([corners, np.full((2, 2, 1), depth * 0.25 + 0.001)], axis=2), uv)
    return shifted({"frame": frame, "print": [panel]}, z=depth / 2)


def make_photo(rng: Rng) -> Thing:
    """A small picture that leans back on its prop."""
    width, height, lean = uniforms(rng, (0.09, 0.22), (0.12, 0.28), (0.12, 0.3))
    picture = framed(rng, width, height)
    leaning = {slot: [surface.turned(-lean, axis=0) for surface in surfaces] for slot, surfaces in picture.items()}
    reach = height * 0.7
    prop = tube([(0, reach * math.cos(lean), -reach * math.sin(lean)), (0, 0, -height * 0.4)], 0.004, 6)
    return standing("photo", leaning, {"metal": [prop]})


def make_picture(rng: Rng) -> Thing:
    """A framed print for a wall: its back at z = 0, facing +z."""
    return assembled("picture", framed(rng, rng.uniform(0.25, 1.2), rng.uniform(0.25, 1.0)))


def make_glazed_mirror(rng: Rng) -> Thing:
    """A framed mirror behind a pane for a wall: its back at z = 0, facing +z."""
    width, height, gap = uniforms(rng, (0.4, 1.1), (0.5, 1.2), (0.01, 0.03))
    inside = width - 2 * EDGE - 0.002, height - 2 * EDGE - 0.002
    frame = [board.at(z=0.02 + gap / 2) for board in rim(width, height, EDGE, 0.04 + gap)]
    mirror = slab(*inside, 0.004).at(0, EDGE + 0.001, 0.003)
    pane = slab(*inside, 0.004).at(0, EDGE + 0.001, 0.007 + gap)
    return assembled("glazed_mirror", {"frame": frame, "mirror": [mirror], "clear": [pane]})


def make_blind(rng: Rng, width: float, height: float) -> Thing:
    """Thin tilted slats with a rail and cords, for a window `width` x `height` in the xy plane."""
    depth, pitch = uniforms(rng, (0.025, 0.05), (0.035, 0.055))
    levels = np.linspace(depth / 2, height - 0.03 - depth / 2, max(2, round(height / pitch)))
    slat = slab(width, 0.0015, depth).turned(rng.uniform(-1.2, 1.2), axis=0)
    slats = [slat.at(0, y) for y in levels]
    cord = slab(0.002, height, 0.002)
    rail = slab(width, 0.03, 0.04).at(0, height - 0.03)
    return assembled("blind", {"slat": slats, "metal": [rail, cord.at(-width / 3), cord.at(width / 3)]})


def make_curtain(rng: Rng, width: float, height: float) -> Thing:
    """A wavy sheet of cloth `width` x `height` about the xy plane; its waves grow downwards."""
    waves = max(2, round(width / rng.uniform(0.09, 0.2)))
    columns = 16 * waves + 1
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, columns), np.linspace(0, height, 5))
    down = 1 - y / height
    knots = np.arange(0, columns, 16)
    uneven = np.interp(np.arange(columns), knots, rng.normal(0, 1, waves + 1))
    late = np.interp(np.arange(columns), knots, rng.normal(0, 1, waves + 1))
    size = width / waves * rng.uniform(0.2, 0.4) * (0.5 + 0.5 * down) * np.exp(0.2 * uneven)
    z = size * np.sin(2 * np.pi * waves * x / width + 0.4 * late + rng.uniform(-1, 1) * down)
    along = np.cumsum(np.hypot(np.gradient(x[-1]), np.gradient(z[-1])))
    uv = np.stack([np.broadcast_to(along, x.shape), y], axis=2)
    return assembled("curtain", {"fabric": [sheet(np.stack([x, y, z], axis=2), uv)]})
