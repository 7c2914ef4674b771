"""Parts that several kinds of furniture share: legs, pedestals, doors and drawers, frames."""

import numpy as np

from scenes.draws import Rng, one_of
from scenes.meshes import Surface, disc, join, lathe, silhouette, slab, solid, tube
from scenes.objects.thing import SurfacesBySlot, evenly


def corners(width: float, depth: float) -> list[tuple[float, float]]:
    """The corners (x, z) of a rectangle about the y axis."""
    return [(x, z) for x in (-width / 2, width / 2) for z in (-depth / 2, depth / 2)]


def legs(rng: Rng, width: float, depth: float, height: float) -> SurfacesBySlot:
    """Legs of one of several kinds under a board `width` x `depth`; they reach up to `height`."""
    kind = rng.integers(5)
    thickness = rng.uniform(0.03, 0.07)
    inside = corners(width - 2 * thickness, depth - 2 * thickness)
    sides = (thickness - width / 2, width / 2 - thickness)
    if kind == 0:
        return {"wood": [slab(thickness, height, thickness).at(x, 0, z) for x, z in inside]}
    if kind == 1:  # turned on a lathe
        outer = silhouette(rng.uniform(0.25, 0.5, 6) * thickness, height, 16)
        return {"wood": [lathe(solid(outer), 12).at(x, 0, z) for x, z in inside]}
    if kind == 2:  # splayed and tapered
        splay = rng.uniform(0.8, 1.0)
        radius = thickness / 2
        paths = [((x, 0, z), (x * splay, height, z * splay)) for x, z in inside]
        return {"wood": [tube(path, [radius * 0.5, radius], 10) for path in paths]}
    if kind == 3:  # frames of metal rod
        rod = rng.uniform(0.006, 0.015)
        end = depth / 2 - thickness
        rods = [tube([(x, 0, z), (x, height, z)], rod) for x, z in inside]
        runners = [tube([(x, y, -end), (x, y, end)], rod) for x in sides for y in (rod, height - rod)]
        return {"metal": rods + runners}
    panels = [slab(thickness, height, depth * 0.9).at(x) for x in sides]
    beam = min(0.08, height / 2)
    return {"wood": [*panels, slab(width - 2 * thickness, beam, 0.02).at(0, height - beam)]}


def pedestal(rng: Rng, radius: float, height: float) -> SurfacesBySlot:
    """A foot and a turned column that carry a round board of `radius` at `height`."""
    foot = radius * rng.uniform(0.5, 0.75)
    column = rng.uniform(0.02, 0.05)
    outer = silhouette(column * rng.uniform(0.7, 1.5, 6), height - 0.02, 20)
    slot = one_of(rng, ("wood", "metal"))
    return {slot: [disc(foot, 0.025), lathe(solid(outer), 20).at(0, 0.02)]}


def handle(rng: Rng, upright: bool) -> Surface:
    """A knob, or a bar that is upright or lies, before the plane z = 0."""
    is_bar = rng.random() < 0.5
    reach = rng.uniform(0.04, 0.12)
    if not is_bar:
        return lathe(solid(silhouette([0.006, 0.005, 0.014, 0.012], 0.025, 8)), 12).turned(np.pi / 2, axis=0)
    rod = tube([(0, -reach, 0.03), (0, reach, 0.03)], 0.005, 6)
    posts = [tube([(0, y, 0), (0, y, 0.03)], 0.004, 6) for y in (-0.9 * reach, 0.9 * reach)]
    return join([rod, *posts]).turned(0 if upright else np.pi / 2, axis=2)


def fronts(rng: Rng, width: float, height: float, columns: int, rows: int) -> SurfacesBySlot:
    """Doors or drawers with handles that fill a face `width` x `height`, standing on the origin, back at z = 0."""
    gap = 0.006
    cell_width = width / columns
    cell_height = height / rows
    upright = cell_height > cell_width
    grip = handle(rng, upright)
    board = slab(cell_width - gap, cell_height - gap, 0.018)
    boards: list[Surface] = []
    grips: list[Surface] = []
    for column, x in enumerate(evenly(width, columns)):
        outward = 1 if column % 2 == 0 else -1
        aside = (cell_width / 2 - 0.05) * outward if upright else 0
        for y in evenly(height, rows) + height / 2:
            boards.append(board.at(x, y - (cell_height - gap) / 2, 0.009))
            grips.append(grip.at(x + aside, y, 0.018))
    return {"front": boards, "metal": grips}


def rim(width: float, height: float, border: float, depth: float) -> list[Surface]:
    """Four boards around a rectangle in the xy plane that stands on the origin."""
    level = [slab(width, border, depth).at(0, y) for y in (0, height - border)]
    upright = slab(border, height - 2 * border, depth)
    return level + [upright.at(x, border) for x in (border / 2 - width / 2, width / 2 - border / 2)]
