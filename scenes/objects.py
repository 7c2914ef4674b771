"""Random things for interiors: furniture, small decor, and what hangs. Metres, y up, fronts towards +z."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from scenes.animation import Array
from scenes.meshes import (
    Surface,
    blob,
    circle,
    disc,
    gem,
    hollow,
    join,
    lathe,
    leaf,
    pad,
    sheet,
    silhouette,
    slab,
    solid,
    tube,
)

Rng = np.random.Generator
Slots = dict[str, list[Surface]]


@dataclass(frozen=True)
class Part:
    """One mesh of a thing, with texture coordinates and unit outward vertex normals.

    Parts of a thing have different slots, which hint at their materials: wood, front (doors, lids, panels), metal,
    stone, ceramic, glass, wax, body (anything); fabric, cushion, blanket, shade; slat; leaf, stem, soil; paper,
    cover-1 to cover-3; frame, and print, whose texture coordinates are 0..1.
    """

    mesh: trimesh.Trimesh
    slot: str
    smooth: bool = False  # shade with the mesh's vertex normals


@dataclass(frozen=True)
class Support:
    """A horizontal rectangle on which smaller things may stand."""

    low: tuple[float, float]  # x, z
    high: tuple[float, float]  # x, z
    height: float  # y
    clearance: float = math.inf  # free height above

    def at(self, x: float, y: float, z: float) -> "Support":
        """Shifted by (x, y, z)."""
        low, high = (self.low[0] + x, self.low[1] + z), (self.high[0] + x, self.high[1] + z)
        return replace(self, low=low, high=high, height=self.height + y)


@dataclass(frozen=True)
class Thing:
    """An object in its rest pose, one part a slot. Furniture and decor stand on y = 0, centred on the y axis."""

    name: str
    parts: tuple[Part, ...]
    supports: tuple[Support, ...] = ()

    @property
    def bounds(self) -> Array:
        """Lowest and highest x, y, z (2, 3)."""
        boxes = np.array([part.mesh.bounds for part in self.parts])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


Maker = Callable[[Rng], Thing]


def moved(slots: Slots, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Slots:
    """Shifted by (x, y, z)."""
    return {slot: [surface.at(x, y, z) for surface in surfaces] for slot, surfaces in slots.items()}


def assembled(name: str, slots: Slots) -> Thing:
    joined = {slot: join(surfaces) for slot, surfaces in slots.items() if surfaces}
    return Thing(name, tuple(Part(surface.mesh(), slot, surface.smooth) for slot, surface in joined.items()))


def standing(name: str, slots: Slots, supports: Sequence[Support] = ()) -> Thing:
    """Assembled, then shifted to stand on y = 0, centred on the y axis."""
    points = np.concatenate([surface.points for surfaces in slots.values() for surface in surfaces])
    low, high = points.min(axis=0), points.max(axis=0)
    shift = float(-(low[0] + high[0]) / 2), float(-low[1]), float(-(low[2] + high[2]) / 2)
    return replace(assembled(name, moved(slots, *shift)), supports=tuple(support.at(*shift) for support in supports))


def merged(*groups: Slots) -> Slots:
    """All surfaces of all groups, by slot."""
    slots: Slots = {}
    for group in groups:
        for slot, surfaces in group.items():
            slots[slot] = slots.get(slot, []) + surfaces
    return slots


def top(width: float, depth: float, height: float, clearance: float = math.inf, margin: float = 0.01) -> Support:
    """The support on a board `width` x `depth` about the y axis, whose upper side is at `height`."""
    x, z = width / 2 - margin, depth / 2 - margin
    return Support((-x, -z), (x, z), height, clearance)


def one_of(rng: Rng, *options: str) -> str:
    return options[int(rng.integers(len(options)))]


def evenly(width: float, count: int) -> Array:
    """Positions (count,) of the middles of `count` equal pieces of -width / 2..width / 2."""
    return ((np.arange(count) + 0.5) / count - 0.5) * width


# Parts of furniture


def corners(width: float, depth: float) -> list[tuple[float, float]]:
    return [(x, z) for x in (-width / 2, width / 2) for z in (-depth / 2, depth / 2)]


def legs(rng: Rng, width: float, depth: float, height: float) -> Slots:
    """Supports of one of several kinds under a board `width` x `depth`; they reach up to `height`."""
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
        splay, radius = rng.uniform(0.8, 1.0), thickness / 2
        path = [((x, 0, z), (x * splay, height, z * splay)) for x, z in inside]
        return {"wood": [tube(ends, [radius * 0.5, radius], 10) for ends in path]}
    if kind == 3:  # frames of metal rod
        rod, end = rng.uniform(0.006, 0.015), depth / 2 - thickness
        rods = [tube([(x, 0, z), (x, height, z)], rod) for x, z in inside]
        runners = [tube([(x, y, -end), (x, y, end)], rod) for x in sides for y in (rod, height - rod)]
        return {"metal": rods + runners}
    panels = [slab(thickness, height, depth * 0.9).at(x) for x in sides]
    beam = min(0.08, height / 2)
    return {"wood": [*panels, slab(width - 2 * thickness, beam, 0.02).at(0, height - beam)]}


def pedestal(rng: Rng, radius: float, height: float) -> Slots:
    """A foot and a lathed column that carry a round board of `radius`."""
    foot, column = radius * rng.uniform(0.5, 0.75), rng.uniform(0.02, 0.05)
    outer = silhouette(column * rng.uniform(0.7, 1.5, 6), height - 0.02, 20)
    slot = one_of(rng, "wood", "metal")
    return {slot: [disc(foot, 0.025), lathe(solid(outer), 20).at(0, 0.02)]}


def fronts(rng: Rng, width: float, height: float, columns: int, rows: int) -> Slots:
    """Doors or drawers with handles that fill a face `width` x `height`, standing on the origin, back at z = 0."""
    gap, bar, reach = 0.006, rng.random() < 0.5, rng.uniform(0.04, 0.12)
    w, h = width / columns, height / rows
    knob = lathe(solid(silhouette([0.006, 0.005, 0.014, 0.012], 0.025, 8)), 12).turned(np.pi / 2, axis=0)
    upright = h > w
    rod = tube([(0, -reach, 0.03), (0, reach, 0.03)], 0.005, 6)
    posts = [tube([(0, y, 0), (0, y, 0.03)], 0.004, 6) for y in (-0.9 * reach, 0.9 * reach)]
    handle = join([rod, *posts]).turned(0 if upright else np.pi / 2, axis=2) if bar else knob
    boards, handles = [], []
    for i, x in enumerate(evenly(width, columns)):
        for y in evenly(height, rows) + height / 2:
            boards.append(slab(w - gap, h - gap, 0.018).at(x, y - (h - gap) / 2, 0.009))
            side = (w / 2 - 0.05) * (1 if i % 2 == 0 else -1) if upright else 0
            handles.append(handle.at(x + side, y, 0.018))
    return {"front": boards, "metal": handles}


# Furniture


def table(rng: Rng) -> Thing:
    height, thickness = rng.choice([0.42, 0.75, 0.9]) * rng.uniform(0.92, 1.08), rng.uniform(0.015, 0.05)
    if rng.random() < 0.4:
        radius = rng.uniform(0.28, 0.65)
        side = radius * math.sqrt(2)
        frame = pedestal(rng, radius, height) if rng.random() < 0.5 else legs(rng, side, side, height)
        board = disc(radius, thickness)
        width = depth = side
    else:
        width, depth = rng.uniform(0.5, 1.9), rng.uniform(0.45, 0.95)
        frame = legs(rng, width, depth, height)
        board = slab(width, thickness, depth)
    slots = merged({one_of(rng, "wood", "wood", "wood", "stone", "glass"): [board.at(0, height)]}, frame)
    return standing("table", slots, [top(width, depth, height + thickness)])


def seat(rng: Rng, width: float, depth: float) -> tuple[Slots, float]:
    """A chair's seat standing on the origin, and its thickness."""
    if rng.random() < 0.5:
        thickness = rng.uniform(0.02, 0.04)
        return {"wood": [slab(width, thickness, depth)]}, thickness
    thickness = rng.uniform(0.05, 0.09)
    return {
        "wood": [slab(width, 0.02, depth)],
        "cushion": [pad(width, thickness - 0.01, depth, 6).at(0, 0.01)],
    }, thickness


def back(rng: Rng, width: float, height: float) -> Slots:
    """A chair's back in the xy plane, standing on the origin: posts with slats, spindles or a panel between."""
    post, kind = rng.uniform(0.025, 0.04), rng.integers(3)
    slots: Slots = {"wood": [slab(post, height, post).at(x) for x in (post / 2 - width / 2, width / 2 - post / 2)]}
    slots["wood"].append(slab(width, 0.05, 0.02).at(0, height - 0.05))
    inner, count = width - 2 * post, int(rng.integers(3, 7))
    if kind == 0:
        slots["wood"] += [slab(inner, 0.04, 0.015).at(0, y) for y in np.linspace(0.12, height - 0.12, count)]
    elif kind == 1:
        slots["wood"] += [tube([(x, 0, 0), (x, height - 0.04, 0)], 0.008) for x in evenly(inner, count)]
    else:
        slots["cushion"] = [pad(inner, height - 0.15, 0.05, 5).at(0, 0.08)]
    return slots


def chair(rng: Rng) -> Thing:
    width, depth, height = rng.uniform(0.4, 0.5), rng.uniform(0.4, 0.5), rng.uniform(0.4, 0.47)
    base, thickness = seat(rng, width, depth)
    slots = merged(
        legs(rng, width, depth, height),
        moved(base, y=height),
        moved(back(rng, width, rng.uniform(0.35, 0.6)), y=height + 0.01, z=0.025 - depth / 2),
    )
    free = Support((-width / 2 + 0.05, -depth / 2 + 0.08), (width / 2 - 0.05, depth / 2 - 0.05), height + thickness)
    return standing("chair", slots, [free])


def stool(rng: Rng) -> Thing:
    radius, height = rng.uniform(0.15, 0.22), rng.uniform(0.42, 0.75)
    side = radius * math.sqrt(2)
    frame = pedestal(rng, radius, height) if rng.random() < 0.3 else legs(rng, side, side, height)
    board = {"wood": [disc(radius, 0.03).at(0, height)]}
    if rng.random() < 0.4:
        thickness = rng.uniform(0.05, 0.1)
        cushion = lathe(solid(silhouette([radius * 0.9, radius, radius, radius * 0.9], thickness, 10)))
        return standing("stool", merged(frame, board, {"cushion": [cushion.at(0, height + 0.03)]}))
    return standing("stool", merged(frame, board), [top(side, side, height + 0.03)])


def bench(rng: Rng) -> Thing:
    width, depth, height = rng.uniform(0.8, 1.6), rng.uniform(0.3, 0.42), rng.uniform(0.4, 0.48)
    count, thickness = int(rng.integers(1, 6)), rng.uniform(0.02, 0.045)
    planks = [slab(width, thickness, depth / count - 0.008).at(0, height, z) for z in evenly(depth, count)]
    slots = merged({"wood": planks}, legs(rng, width, depth, height))
    return standing("bench", slots, [top(width, depth, height + thickness)])


def upholstered(rng: Rng, name: str, seats: int) -> Thing:
    """A sofa with that many seats; one makes an armchair."""
    place, depth, foot = rng.uniform(0.55, 0.75), rng.uniform(0.75, 0.95), rng.uniform(0.04, 0.16)
    arm, soft = rng.uniform(0.1, 0.22), rng.uniform(3, 9)
    level, rise, lean = foot + rng.uniform(0.2, 0.28), rng.uniform(0.35, 0.55), rng.uniform(0.05, 0.25)
    inner, width = seats * place, seats * place + 2 * arm
    side = pad(arm, level + rng.uniform(0.12, 0.22) - foot, depth, soft)
    body = [
        pad(width - arm, level - foot, depth * 0.96, 9).at(0, foot),
        pad(inner + arm, level + rise - foot - 0.06, 0.22, soft, 3).at(0, foot, 0.11 - depth / 2),
        *(side.at(x, foot) for x in (-(inner + arm) / 2, (inner + arm) / 2)),
    ]
    cushion = pad(place - 0.01, 0.16, depth - 0.26, soft)
    rest = pad(place - 0.03, rise, 0.2, rng.uniform(2.5, 5)).turned(-lean, axis=0)
    pair = [cushion.at(0, level - 0.04, 0.11), rest.at(0, level + 0.1, 0.3 - depth / 2)]
    cushions = [part.at(x) for x in evenly(inner, seats) for part in pair]
    leg = lathe(solid([(0.02, 0), (0.03, foot + 0.03)]), 12)
    feet = [leg.at(x, 0, z) for x, z in corners(width - 0.12, depth - 0.12)]
    return standing(name, {"fabric": body, "cushion": cushions, "wood": feet})


def sofa(rng: Rng) -> Thing:
    return upholstered(rng, "sofa", int(rng.integers(2, 4)))


def armchair(rng: Rng) -> Thing:
    return upholstered(rng, "armchair", 1)


def bed(rng: Rng) -> Thing:
    width, depth, level = rng.uniform(0.9, 1.8), rng.uniform(1.95, 2.15), rng.uniform(0.22, 0.4)
    thickness, head = rng.uniform(0.15, 0.26), rng.uniform(0.4, 0.8)
    frame = [slab(width + 0.06, 0.1, depth + 0.06).at(0, level - 0.1)]
    frame.append(slab(width + 0.06, level + head, 0.05).at(0, 0, -depth / 2 - 0.05))
    frame += [slab(0.08, level - 0.1, 0.08).at(x, 0, z) for x, z in corners(width - 0.1, depth - 0.1)]
    cover = rng.uniform(0.5, 0.75) * depth
    blanket = pad(width + 0.04, thickness + 0.02, cover, 9, 3).at(0, level + 0.02, (depth - cover) / 2 + 0.02)
    count = 1 if width < 1.3 else 2
    pillow = pad(width / count - 0.1, 0.13, 0.4, rng.uniform(2.5, 4)).turned(0.15, axis=0)
    pillows = [pillow.at(x, level + thickness - 0.02, 0.28 - depth / 2) for x in evenly(width, count)]
    mattress = pad(width, thickness, depth, 16, 3).at(0, level)
    return standing("bed", {"wood": frame, "fabric": [mattress], "blanket": [blanket], "cushion": pillows})


def shelf(rng: Rng) -> Thing:
    """An open bookcase with supports on every board."""
    width, height, depth = rng.uniform(0.5, 1.4), rng.uniform(0.7, 2.1), rng.uniform(0.24, 0.4)
    board, rows = rng.uniform(0.015, 0.035), max(2, round(height / rng.uniform(0.28, 0.45)))
    columns = int(rng.integers(1, 3)) if width > 0.8 else 1
    inner = width - 2 * board
    levels = np.linspace(rng.uniform(0, 0.1), height - board, rows + 1)
    wood = [slab(inner, board, depth).at(0, y) for y in levels]
    wood += [slab(board, height, depth).at(x) for x in (board / 2 - width / 2, width / 2 - board / 2)]
    between = np.linspace(-inner / 2, inner / 2, columns + 1)[1:-1]
    wood += [slab(board, levels[-1] - levels[0], depth).at(x, levels[0]) for x in between]
    slots: Slots = {"wood": wood}
    if rng.random() < 0.6:
        slots["front"] = [slab(width - 0.01, height - 0.01, 0.008).at(0, 0.005, -depth / 2)]
    supports = [top(width, depth, height)]
    cell, clearance = inner / columns, levels[1] - levels[0] - board
    for y in levels[:-1]:
        supports += [top(cell, depth, y + board, clearance, 0.03).at(x, 0, 0) for x in evenly(inner, columns)]
    return standing("shelf", slots, supports)


def cabinet(rng: Rng) -> Thing:
    width, height, depth = rng.uniform(0.4, 1.6), rng.uniform(0.45, 1.1), rng.uniform(0.35, 0.55)
    foot, rows = rng.uniform(0.03, 0.2), int(rng.integers(1, 5))
    columns = max(1, round(width / rng.uniform(0.4, 0.6)))
    box = slab(width, height, depth).at(0, foot)
    doors = moved(fronts(rng, width - 0.02, height - 0.02, columns, rows), 0, foot + 0.01, depth / 2)
    lid = slab(width + 0.03, 0.02, depth + 0.04).at(0, foot + height, 0.01)
    slots = merged({"wood": [box, lid]}, doors, legs(rng, width, depth, foot + 0.001))
    return standing("cabinet", slots, [top(width, depth, foot + height + 0.02)])


def desk(rng: Rng) -> Thing:
    width, depth, height = rng.uniform(1.0, 1.7), rng.uniform(0.55, 0.8), rng.uniform(0.7, 0.78)
    thickness, block = rng.uniform(0.02, 0.04), rng.uniform(0.35, 0.45)
    side, rows = (-1, 1)[rng.integers(2)], int(rng.integers(2, 5))
    x, tall = side * (width - block) / 2, height - 0.08
    drawers = moved(fronts(rng, block - 0.01, tall - 0.01, 1, rows), x, 0.085, depth / 2 - 0.08)
    body = {"wood": [slab(block, tall, depth - 0.1).at(x, 0.08, -0.03), slab(width, thickness, depth).at(0, height)]}
    slots = merged(body, drawers, legs(rng, width, depth, height))
    return standing("desk", slots, [top(width, depth, height + thickness)])


def screen(rng: Rng) -> Thing:
    """A folding divider: frames filled with a thin grid, bars or louvres."""
    width, height, bar = rng.uniform(0.4, 0.6), rng.uniform(1.3, 1.9), rng.uniform(0.006, 0.018)
    kind, fold, count = rng.integers(3), rng.uniform(0.2, 0.6), int(rng.integers(2, 5))
    columns, rows = int(rng.integers(4, 9)), int(rng.integers(10, 22))
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
    return standing("screen", {one_of(rng, "wood", "metal"): folded})


def arc(rng: Rng, start: ArrayLike, length: float, azimuth: float, droop: float, count: int = 8) -> Array:
    """A path (count, 3) in the vertical plane of `azimuth` that rises from `start` and bends down, above y = 0."""
    t = np.linspace(0, 1, count)
    out, up = rng.uniform(0.4, 0.8) * t, 0.9 * t - droop * t**2
    bent = np.stack([math.cos(azimuth) * out, up, math.sin(azimuth) * out], axis=1) * length + np.asarray(start)
    return np.maximum(bent, (-np.inf, 0.01, -np.inf))


def foliage(rng: Rng, start: float, height: float) -> Slots:
    """Stems with thin leaves that grow from (0, `start`, 0) to about `height`."""
    size = height - start
    if rng.random() < 0.4:  # long leaves from one point
        paths = [
            arc(rng, (0, start, 0), size * rng.uniform(0.5, 0.9), azimuth, rng.uniform(0.1, 1.2))
            for azimuth in rng.uniform(0, 2 * np.pi, rng.integers(14, 36))
        ]
        width, fold = size * rng.uniform(0.03, 0.09), rng.uniform(0, 0.6)
        return {"leaf": [leaf(path, width, fold) for path in paths]}
    slots: Slots = {"stem": [], "leaf": []}
    length, ratio, fold = size * rng.uniform(0.15, 0.35), rng.uniform(0.3, 0.8), rng.uniform(0, 0.5)
    for azimuth in rng.uniform(0, 2 * np.pi, rng.integers(2, 7)):
        tall = size * rng.uniform(0.6, 1.0)
        lean = np.linspace(0, 1, 8)[:, None] ** 2 * rng.uniform(0.05, 0.35) * tall
        path = np.array([0, start, 0]) + lean * (math.cos(azimuth), 0, math.sin(azimuth))
        path[:, 1] += np.linspace(0, tall, 8)
        slots["stem"].append(tube(path, np.linspace(0.012, 0.005, 8) * size, 6))
        for k in rng.integers(2, 8, 14):
            bent = arc(
                rng, path[k], length * rng.uniform(0.7, 1.2), rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 1.2), 6
            )
            slots["leaf"].append(leaf(bent, length * ratio, fold))
    return slots


def potted(rng: Rng, name: str, radius: float, height: float) -> Thing:
    """A plant in a pot of about `radius`, about `height` tall in all."""
    deep = min(radius * rng.uniform(1.2, 2.0), height / 2)
    wall, level = radius * 0.08, deep * 0.85
    outer = silhouette(np.sort(rng.uniform(0.65, 1.0, 3)) * radius, deep, 12)
    soil = disc(float(np.interp(level, outer[:, 1], outer[:, 0])) - wall / 2, 0.02 * deep, 24).at(0, level)
    slots: Slots = {"ceramic": [lathe(hollow(outer, wall, deep * 0.8), 28)], "soil": [soil]}
    return standing(name, merged(slots, foliage(rng, level, height)))


def floor_plant(rng: Rng) -> Thing:
    return potted(rng, "floor_plant", rng.uniform(0.1, 0.22), rng.uniform(0.7, 1.7))


def floor_lamp(rng: Rng) -> Thing:
    """A stand with an open shade, without a light."""
    height, bow = rng.uniform(1.2, 1.7), rng.uniform(0, 0.35) * (rng.random() < 0.5)
    t = np.linspace(0, 1, 12)
    path = np.stack([bow * t**3, 0.02 + (height - 0.12) * t, 0 * t], axis=1)
    radius, tall = rng.uniform(0.12, 0.24), rng.uniform(0.18, 0.32)
    shade = lathe([(radius, 0), (radius * rng.uniform(0.4, 1.0), tall)], 36).at(bow, height - tall)
    metal = [disc(rng.uniform(0.12, 0.18), 0.025), tube(path, rng.uniform(0.008, 0.016))]
    return standing("floor_lamp", {"metal": metal, "shade": [shade]})


def column(rng: Rng) -> Thing:
    """A plinth, or a lathed column between two plates; both carry things."""
    width, height = rng.uniform(0.22, 0.42), rng.uniform(0.5, 1.3)
    plate = slab(width, 0.05, width)
    if rng.random() < 0.5:
        body = slab(width - 0.04, height - 0.1, width - 0.04).at(0, 0.05)
    else:
        outer = silhouette(rng.uniform(0.28, 0.46, 7) * width, height - 0.1, 28)
        body = lathe(solid(outer)).at(0, 0.05)
    slots = {one_of(rng, "stone", "wood"): [plate, body, plate.at(0, height - 0.05)]}
    return standing("column", slots, [top(width, width, height)])


# Decor


def vessel(rng: Rng, name: str, radii: ArrayLike, radius: float, height: float, *slots: str) -> Thing:
    """A hollow lathe whose side passes through `radii` * `radius`, of one of the `slots`."""
    wall = radius * rng.uniform(0.04, 0.1)
    outer = silhouette(np.asarray(radii) * radius, height, 24)
    return standing(name, {one_of(rng, *slots): [lathe(hollow(outer, wall, 2 * wall), 40)]})


def vase(rng: Rng) -> Thing:
    radii, radius, height = rng.uniform(0.35, 1.0, 5), rng.uniform(0.05, 0.13), rng.uniform(0.12, 0.42)
    return vessel(rng, "vase", radii, radius, height, "ceramic", "glass", "metal")


def bowl(rng: Rng) -> Thing:
    rise = np.linspace(rng.uniform(0.05, 0.2), 1, 6) ** rng.uniform(0.3, 0.7)
    radius, height = rng.uniform(0.07, 0.2), rng.uniform(0.05, 0.12)
    return vessel(rng, "bowl", rise, radius, height, "ceramic", "wood", "metal", "glass")


def bottle(rng: Rng) -> Thing:
    neck, shoulder = rng.uniform(0.28, 0.45), rng.uniform(0.85, 1.0)
    radii = (0.95, 1, 1, shoulder, neck, neck, neck * 1.1)
    return vessel(rng, "bottle", radii, rng.uniform(0.03, 0.06), rng.uniform(0.18, 0.34), "glass", "glass", "ceramic")


def cup(rng: Rng) -> Thing:
    radius, height = rng.uniform(0.035, 0.05), rng.uniform(0.06, 0.11)
    outer = silhouette(radius * np.array([0.8, 0.95, 1, rng.uniform(0.9, 1.1)]), height, 12)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 10)
    bent = np.stack(
        [np.cos(angle) * height * 0.3 + radius * 0.92, height * (0.5 + 0.3 * np.sin(angle)), 0 * angle], axis=1
    )
    surfaces = [lathe(hollow(outer, 0.004, 0.006), 32).at(0, 0.004), tube(bent, height * 0.05).at(0, 0.004)]
    if rng.random() < 0.5:
        saucer = silhouette(radius * np.array([0.9, 1.5, 1.8]), 0.015, 8)
        surfaces.append(lathe(hollow(saucer, 0.004, 0.004), 32))
    return standing("cup", {"ceramic": surfaces})


def glass(rng: Rng) -> Thing:
    """A tumbler or a goblet: one thin-walled closed surface."""
    radius = rng.uniform(0.03, 0.045)
    if rng.random() < 0.5:
        height = rng.uniform(0.08, 0.15)
        outer, base = silhouette([radius * rng.uniform(0.75, 1.0), radius, radius], height, 10), 0.008
    else:
        height = rng.uniform(0.14, 0.22)
        bulge, mouth = rng.uniform(0.9, 1.1), rng.uniform(0.75, 1.0)
        radii = radius * np.array([0.85, 0.1, 0.1, 0.12, 0.9 * bulge, bulge, mouth])
        outer, base = silhouette(radii, height, 36), height * 0.53
    return standing("glass", {"glass": [lathe(hollow(outer, 0.0015, base), 40)]})


def book(width: float, height: float, depth: float) -> tuple[Surface, Surface]:
    """A book lying on the origin, its spine towards -x: cover and pages."""
    board = 0.003
    boards = [slab(width, board, depth), slab(width, board, depth).at(0, height - board)]
    cover = join([*boards, slab(board, height, depth).at(board / 2 - width / 2)])
    return cover, slab(width - 0.008, height - 2 * board, depth - 0.01).at(0, board)


def books(rng: Rng) -> Thing:
    """A stack of lying books."""
    slots: Slots = {}
    level = 0.0
    for _ in range(rng.integers(2, 7)):
        width, height, depth = rng.uniform(0.13, 0.22), rng.uniform(0.012, 0.045), rng.uniform(0.18, 0.28)
        angle = rng.normal(0, 0.25)
        cover, pages = (part.turned(angle).at(0, level) for part in book(width, height, depth))
        slots = merged(slots, {f"cover-{rng.integers(1, 4)}": [cover], "paper": [pages]})
        level += height
    return standing("books", slots)


def book_row(rng: Rng) -> Thing:
    """Books that stand side by side, spines to the front."""
    slots: Slots = {}
    x = 0.0
    for _ in range(rng.integers(4, 12)):
        width, height, depth = rng.uniform(0.13, 0.18), rng.uniform(0.012, 0.045), rng.uniform(0.18, 0.27)
        cover, pages = (
            part.at(width / 2).turned(np.pi / 2, axis=0).turned(np.pi / 2, axis=1).at(x, depth / 2)
            for part in book(width, height, depth)
        )
        slots = merged(slots, {f"cover-{rng.integers(1, 4)}": [cover], "paper": [pages]})
        x += height
    return standing("book_row", slots)


def box(rng: Rng) -> Thing:
    """A chest with a lid, or a bare block."""
    width, height, depth = rng.uniform(0.06, 0.35), rng.uniform(0.05, 0.3), rng.uniform(0.06, 0.3)
    body = slab(width, height, depth)
    if rng.random() < 0.5:
        return standing("box", {"body": [body]})
    lid = slab(width + 0.008, height * rng.uniform(0.1, 0.3), depth + 0.008).at(0, height)
    return standing("box", {"body": [body], "front": [lid]})


def ball(rng: Rng) -> Thing:
    size = rng.uniform(0.06, 0.3)
    return standing("ball", {"body": [pad(size, size, size, 2, 3)]})


def ring(rng: Rng) -> Thing:
    """A torus, upright or lying."""
    radius = rng.uniform(0.04, 0.15)
    torus = lathe(circle(radius, radius * rng.uniform(0.1, 0.45), 16), 48)
    return standing("ring", {"body": [torus.turned(np.pi / 2 * rng.integers(2), axis=0)]})


def lump(rng: Rng) -> Thing:
    """A smooth irregular body."""
    subdivisions = int(rng.integers(3, 5))
    return standing("lump", {"body": [blob(rng, rng.uniform(0.05, 0.16), rng.uniform(0.05, 0.3), subdivisions)]})


def crystal(rng: Rng) -> Thing:
    """A body with flat facets."""
    return standing("crystal", {"body": [gem(rng, rng.uniform(0.04, 0.16), int(rng.integers(2)))]})


def candle(rng: Rng) -> Thing:
    height, radius, wax = rng.uniform(0.05, 0.28), rng.uniform(0.04, 0.07), rng.uniform(0.008, 0.02)
    holder = silhouette(radius * np.array([1, *rng.uniform(0.2, 0.6, 4), 0.8]), height, 24)
    stick = lathe(solid([(wax, 0), (wax * 0.95, rng.uniform(0.06, 0.18))]), 20).at(0, height)
    return standing("candle", {one_of(rng, "metal", "ceramic", "wood"): [lathe(solid(holder))], "wax": [stick]})


def small_plant(rng: Rng) -> Thing:
    return potted(rng, "small_plant", rng.uniform(0.03, 0.07), rng.uniform(0.14, 0.42))


def basket(rng: Rng) -> Thing:
    """A basket of thin wires."""
    radius, height, wire = rng.uniform(0.07, 0.16), rng.uniform(0.08, 0.25), rng.uniform(0.0015, 0.0035)
    widths = radius * np.array([rng.uniform(0.6, 0.95), rng.uniform(0.8, 1.1), 1])
    outer = silhouette(widths, height, 7)
    hoops = [lathe(circle(r, wire, 5), 28).at(0, y) for r, y in outer]
    side = np.concatenate([[(0, 0)], outer])
    upright = tube(np.stack([side[:, 0], side[:, 1], np.zeros(len(side))], axis=1), wire, 4)
    return standing("basket", {"metal": hoops + [upright.turned(angle) for angle in evenly(2 * np.pi, 20)]})


def rim(width: float, height: float, border: float, depth: float) -> list[Surface]:
    """Four boards around a rectangle in the xy plane that stands on the origin."""
    level = [slab(width, border, depth).at(0, y) for y in (0, height - border)]
    upright = slab(border, height - 2 * border, depth)
    return level + [upright.at(x, border) for x in (border / 2 - width / 2, width / 2 - border / 2)]


def framed(rng: Rng, width: float, height: float) -> Slots:
    """A picture in a frame, standing on the origin, its back at z = 0, facing +z."""
    border, depth = rng.uniform(0.04, 0.12) * min(width, height), rng.uniform(0.012, 0.035)
    frame = [slab(width - border, height - border, depth * 0.5).at(0, border / 2), *rim(width, height, border, depth)]
    x, y = width / 2 - border, np.array([border, height - border])
    corner = np.array([[(-x, y[0]), (x, y[0])], [(-x, y[1]), (x, y[1])]])
    uv = np.array([[(0.0, 0.0), (1.0, 0.0)], [(0.0, 1.0), (1.0, 1.0)]])
    # The print lies just before the board behind it.
    panel = sheet(np.concatenate([corner, np.full((2, 2, 1), depth * 0.25 + 0.001)], axis=2), uv)
    return moved({"frame": frame, "print": [panel]}, z=depth / 2)


def photo(rng: Rng) -> Thing:
    """A small picture that leans back on its prop."""
    width, height, lean = rng.uniform(0.09, 0.22), rng.uniform(0.12, 0.28), rng.uniform(0.12, 0.3)
    slots = {
        slot: [surface.turned(-lean, axis=0) for surface in surfaces]
        for slot, surfaces in framed(rng, width, height).items()
    }
    reach = height * 0.7
    prop = tube([(0, reach * math.cos(lean), -reach * math.sin(lean)), (0, 0, -height * 0.4)], 0.004, 6)
    return standing("photo", merged(slots, {"metal": [prop]}))


# What hangs: centred on x = 0, lowest point at y = 0


def picture(rng: Rng) -> Thing:
    """A framed print for a wall: its back at z = 0, facing +z."""
    return assembled("picture", framed(rng, rng.uniform(0.25, 1.2), rng.uniform(0.25, 1.0)))


def blind(rng: Rng, width: float, height: float) -> Thing:
    """Thin tilted slats that fill a window `width` x `height` about the xy plane, with a rail and cords."""
    depth, pitch = rng.uniform(0.025, 0.05), rng.uniform(0.035, 0.055)
    levels = np.linspace(depth / 2, height - 0.03 - depth / 2, max(2, round(height / pitch)))
    slat = slab(width, 0.0015, depth).turned(rng.uniform(-1.2, 1.2), axis=0)
    slats = [slat.at(0, y) for y in levels]
    cord = slab(0.002, height, 0.002)
    rail = slab(width, 0.03, 0.04).at(0, height - 0.03)
    return assembled("blind", {"slat": slats, "metal": [rail, cord.at(-width / 3), cord.at(width / 3)]})


def curtain(rng: Rng, width: float, height: float) -> Thing:
    """A wavy sheet of cloth `width` x `height` about the xy plane; its waves grow and drift downwards."""
    waves = max(2, round(width / rng.uniform(0.09, 0.2)))
    columns, rows = 16 * waves + 1, 5
    x, y = np.meshgrid(np.linspace(-width / 2, width / 2, columns), np.linspace(0, height, rows))
    down = 1 - y / height
    uneven, late = (
        np.interp(np.arange(columns), np.arange(0, columns, 16), rng.normal(0, 1, waves + 1)) for _ in range(2)
    )
    size = width / waves * rng.uniform(0.2, 0.4) * (0.5 + 0.5 * down) * np.exp(0.2 * uneven)
    z = size * np.sin(2 * np.pi * waves * x / width + 0.4 * late + rng.uniform(-1, 1) * down)
    along = np.cumsum(np.hypot(np.gradient(x[-1]), np.gradient(z[-1])))
    uv = np.stack([np.broadcast_to(along, x.shape), y], axis=2)
    return assembled("curtain", {"fabric": [sheet(np.stack([x, y, z], axis=2), uv)]})


def pendant(rng: Rng) -> Thing:
    """A shade on a cord, without a light: open below, a whole ball, or a cone. The cord's end hangs from a ceiling."""
    radius, tall, cord = rng.uniform(0.1, 0.25), rng.uniform(0.12, 0.3), rng.uniform(0.2, 0.6)
    kind = rng.integers(3)
    if kind == 0:
        tall = 2 * radius
        shade = pad(tall, tall, tall, 2, 3)
    elif kind == 1:
        shade = lathe([(radius, 0), (radius * rng.uniform(0.1, 0.9), tall)], 36)
    else:
        shade = lathe(silhouette([radius, radius * rng.uniform(0.8, 1.0), radius * 0.7, 0.03], tall, 16), 36)
    line = tube([(0, tall - 0.03, 0), (0, tall + cord, 0)], 0.003, 6)
    return assembled("pendant", {"shade": [shade], "metal": [line]})


FURNITURE: dict[str, Maker] = {
    maker.__name__: maker
    for maker in (
        table,
        chair,
        stool,
        bench,
        sofa,
        armchair,
        bed,
        shelf,
        cabinet,
        desk,
        screen,
        floor_plant,
        floor_lamp,
        column,
    )
}

DECOR: dict[str, Maker] = {
    maker.__name__: maker
    for maker in (
        vase,
        bowl,
        bottle,
        cup,
        glass,
        books,
        book_row,
        box,
        ball,
        ring,
        lump,
        crystal,
        candle,
        small_plant,
        basket,
        photo,
    )
}
