"""Parts of furniture, and tables, desks, shelves, cabinets, columns, screens, showcases and panes made of them."""

import math

import numpy as np

from scenes.draws import Rng, one_of, uniforms
from scenes.meshes import Surface, disc, join, lathe, silhouette, slab, solid, tube
from scenes.objects.thing import SurfacesBySlot, Thing, evenly, shifted, standing, top_support

EDGE = 0.03  # m, width of the frames of panes


def corners(width: float, depth: float) -> list[tuple[float, float]]:
    """The corners (x, z) of a rectangle about the y axis."""
    return [(x, z) for x in (-width / 2, width / 2) for z in (-depth / 2, depth / 2)]


def legs(rng: Rng, width: float, depth: float, height: float) -> SurfacesBySlot:
    """Legs of a random kind under a board `width` x `depth` at `height`."""
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
    outer = silhouette(rng.uniform(0.02, 0.05) * rng.uniform(0.7, 1.5, 6), height - 0.02, 20)
    return {one_of(rng, ("wood", "metal")): [disc(foot, 0.025), lathe(solid(outer), 20).at(0, 0.02)]}


def handle(rng: Rng, upright: bool) -> Surface:
    """A knob, or a vertical or horizontal bar, in front of the plane z = 0."""
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
    cell_width, cell_height = width / columns, height / rows
    upright = cell_height > cell_width
    grip = handle(rng, upright)
    board = slab(cell_width - gap, cell_height - gap, 0.018)
    boards, grips = [], []
    for column, x in enumerate(evenly(width, columns)):
        aside = (cell_width / 2 - 0.05) * (-1) ** column if upright else 0
        for y in evenly(height, rows) + height / 2:
            boards.append(board.at(x, y - (cell_height - gap) / 2, 0.009))
            grips.append(grip.at(x + aside, y, 0.018))
    return {"front": boards, "metal": grips}


def rim(width: float, height: float, border: float, depth: float) -> list[Surface]:
    """Four boards around a rectangle in the xy plane that stands on the origin."""
    level = [slab(width, border, depth).at(0, y) for y in (0, height - border)]
    upright = slab(border, height - 2 * border, depth)
    return level + [upright.at(x, border) for x in (border / 2 - width / 2, width / 2 - border / 2)]


def make_table(rng: Rng) -> Thing:
    """A round or rectangular table, from a couch table's height to a bar table's."""
    height = rng.choice([0.42, 0.75, 0.9]) * rng.uniform(0.92, 1.08)
    thickness = rng.uniform(0.015, 0.05)
    if rng.random() < 0.4:
        radius = rng.uniform(0.28, 0.65)
        width = depth = radius * math.sqrt(2)
        frame = pedestal(rng, radius, height) if rng.random() < 0.5 else legs(rng, width, depth, height)
        board = disc(radius, thickness)
    else:
        width, depth = uniforms(rng, (0.5, 1.9), (0.45, 0.95))
        frame = legs(rng, width, depth, height)
        board = slab(width, thickness, depth)
    top = {one_of(rng, ("wood", "wood", "wood", "stone", "glass")): [board.at(0, height)]}
    return standing("table", top, frame, supports=[top_support(width, depth, height + thickness)])


def make_desk(rng: Rng) -> Thing:
    width, depth, height, thickness = uniforms(rng, (1.0, 1.7), (0.55, 0.8), (0.7, 0.78), (0.02, 0.04))
    block = rng.uniform(0.35, 0.45)
    side = one_of(rng, (-1, 1))
    rows = int(rng.integers(2, 5))
    x = side * (width - block) / 2
    tall = height - 0.08
    drawers = shifted(fronts(rng, block - 0.01, tall - 0.01, 1, rows), x, 0.085, depth / 2 - 0.08)
    body = {"wood": [slab(block, tall, depth - 0.1).at(x, 0.08, -0.03), slab(width, thickness, depth).at(0, height)]}
    free = top_support(width, depth, height + thickness)
    return standing("desk", body, drawers, legs(rng, width, depth, height), supports=[free])


def make_shelf(rng: Rng) -> Thing:
    """An open bookcase with supports on every board."""
    width, height, depth, board = uniforms(rng, (0.5, 1.4), (0.7, 2.1), (0.24, 0.4), (0.015, 0.035))
    rows = max(2, round(height / rng.uniform(0.28, 0.45)))
    columns = int(rng.integers(1, 3)) if width > 0.8 else 1
    inner = width - 2 * board
    levels = np.linspace(rng.uniform(0, 0.1), height - board, rows + 1)
    wood = [slab(inner, board, depth).at(0, y) for y in levels]
    wood += [slab(board, height, depth).at(x) for x in (board / 2 - width / 2, width / 2 - board / 2)]
    between = np.linspace(-inner / 2, inner / 2, columns + 1)[1:-1]
    wood += [slab(board, levels[-1] - levels[0], depth).at(x, levels[0]) for x in between]
    panel = slab(width - 0.01, height - 0.01, 0.008).at(0, 0.005, -depth / 2)
    back = {"front": [panel]} if rng.random() < 0.6 else {}
    supports = [top_support(width, depth, height)]
    cell = inner / columns
    clearance = levels[1] - levels[0] - board
    for y in levels[:-1]:
        free = top_support(cell, depth, y + board, clearance, 0.03)
        supports += [free + np.array([x, 0, 0]) for x in evenly(inner, columns)]
    return standing("shelf", {"wood": wood}, back, supports=supports)


def make_cabinet(rng: Rng) -> Thing:
    width, height, depth, foot = uniforms(rng, (0.4, 1.6), (0.45, 1.1), (0.35, 0.55), (0.03, 0.2))
    rows = int(rng.integers(1, 5))
    columns = max(1, round(width / rng.uniform(0.4, 0.6)))
    body = slab(width, height, depth).at(0, foot)
    doors = shifted(fronts(rng, width - 0.02, height - 0.02, columns, rows), 0, foot + 0.01, depth / 2)
    lid = slab(width + 0.03, 0.02, depth + 0.04).at(0, foot + height, 0.01)
    free = top_support(width, depth, foot + height + 0.02)
    return standing("cabinet", {"wood": [body, lid]}, doors, legs(rng, width, depth, foot + 0.001), supports=[free])


def make_column(rng: Rng) -> Thing:
    """A plinth, or a turned column between two plates; both carry things."""
    width, height = uniforms(rng, (0.22, 0.42), (0.5, 1.3))
    plate = slab(width, 0.05, width)
    if rng.random() < 0.5:
        body = slab(width - 0.04, height - 0.1, width - 0.04).at(0, 0.05)
    else:
        body = lathe(solid(silhouette(rng.uniform(0.28, 0.46, 7) * width, height - 0.1, 28))).at(0, 0.05)
    surfaces = {one_of(rng, ("stone", "wood")): [plate, body, plate.at(0, height - 0.05)]}
    return standing("column", surfaces, supports=[top_support(width, width, height)])


def make_screen(rng: Rng) -> Thing:
    """A folding screen: frames filled with a thin grid, bars or louvres."""
    width, height, bar = uniforms(rng, (0.4, 0.6), (1.3, 1.9), (0.006, 0.018))
    kind = rng.integers(3)
    fold = rng.uniform(0.2, 0.6)
    count = int(rng.integers(2, 5))
    columns = int(rng.integers(4, 9))
    rows = int(rng.integers(10, 22))
    panel = rim(width, height, 0.03, 0.03)
    if kind < 2:
        panel += [slab(bar, height - 0.03, bar).at(x, 0.015) for x in evenly(width - 0.06, columns)]
    if kind == 0:
        panel += [slab(width - 0.03, bar, bar).at(0, y) for y in evenly(height - 0.06, rows) + height / 2]
    if kind == 2:
        louvre = slab(width - 0.05, 0.004, 0.04).turned(rng.uniform(-0.9, 0.9), axis=0)
        panel += [louvre.at(0, y) for y in evenly(height - 0.08, rows * 2) + height / 2]
    step = width * math.cos(fold)
    folded = [join(panel).turned(fold * (-1) ** k).at(k * step) for k in range(count)]
    return standing("screen", {one_of(rng, ("wood", "metal")): folded})


def make_showcase(rng: Rng) -> Thing:
    """A plinth with panes at its front and sides, open above, before a board or a mirror."""
    width, height, depth, tall = uniforms(rng, (0.6, 1.4), (0.5, 0.9), (0.35, 0.55), (0.35, 0.8))
    thickness = rng.uniform(0.004, 0.012)
    aside = slab(thickness, tall, depth - 0.08).at(0, height + 0.001, -0.01)
    panes = [slab(width - 0.01, tall, thickness).at(0, height + 0.001, depth / 2 - thickness)]
    panes += [aside.at(side * (width / 2 - thickness)) for side in (-1, 1)]
    back = slab(width, tall, 0.02).at(0, height + 0.001, 0.01 - depth / 2)
    surfaces = {"wood": [slab(width, height, depth)], "clear": panes, one_of(rng, ("front", "mirror")): [back]}
    inside = top_support(width - 0.06, depth - 0.1, height, margin=0.02)
    return standing("showcase", surfaces, supports=[inside])


def make_pane(rng: Rng) -> Thing:
    """A pane in a frame that stands by itself, as in offices."""
    width, height, thickness = uniforms(rng, (0.7, 1.6), (1.2, 2.0), (0.004, 0.012))
    frame = rim(width, height, EDGE, EDGE)
    feet = [slab(EDGE, 0.02, 0.4).at(side * width / 3) for side in (-1, 1)]
    pane = slab(width - 2 * EDGE - 0.002, height - 2 * EDGE - 0.002, thickness).at(0, EDGE + 0.021)
    surfaces = {"metal": [*(board.at(0, 0.02) for board in frame), *feet], "clear": [pane]}
    return standing("pane", surfaces)


CASES = (make_shelf, make_cabinet, make_desk)
