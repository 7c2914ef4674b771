"""`room-SEED`: any number is another interior, with its own furniture, materials, lights, motions and camera flight."""

from collections.abc import Sequence

import numpy as np

from scenes.animation import RigidMotion, Scene, Shape, Track
from scenes.finish import finish
from scenes.flight import look, path
from scenes.layout import GAP, Group, Layout, laden
from scenes.lighting import (
    HIDDEN,
    OPEN,
    Lamp,
    ceiling_panel,
    hanging,
    orb,
    shine,
    sky,
    sky_panel,
    standing_lamp,
    sun_through,
)
from scenes.meshes import slab
from scenes.objects import DECOR, FURNITURE, Maker, blind, chair, curtain, picture, table
from scenes.shell import Opening, floor, panel, reveal, still, wall_pose, wall_width

Rng = np.random.Generator

FEWEST, MOST_LAMPS = 15, 4  # things and lamps in a room
AGAINST_WALLS = ("sofa", "armchair", "bed", "shelf", "cabinet", "desk", "bench", "screen")


def windows(layout: Layout, count: int) -> None:
    """Openings to the sky in `count` walls, some behind blinds or curtains."""
    rng = layout.rng
    for wall in rng.permutation(4)[:count]:
        span = wall_width(int(wall), layout.size)
        width, height = rng.uniform(0.7, min(3.0, span - 0.6)), rng.uniform(0.7, layout.size[1] - 0.6)
        x, y = rng.uniform(-span / 2 + 0.25, span / 2 - 0.25 - width), rng.uniform(0.2, layout.size[1] - height - 0.2)
        hole = Opening((x, y), (x + width, y + height))
        layout.openings[int(wall)] = [hole]
        frame, thickness = wall_pose(int(wall), layout.size), rng.uniform(0.08, 0.3)
        layout.build("reveal", [reveal(hole, thickness)], frame)
        dressing = rng.random()
        if dressing < 0.35:
            layout.hang(blind(rng, width - 0.02, height - 0.02), int(wall), hole.middle[0], y + 0.01, -0.05)
        elif dressing < 0.6:
            cover = width * rng.uniform(0.3, 0.7)
            layout.hang(curtain(rng, cover, height + 0.2), int(wall), x + cover / 2, y - 0.1, 0.12)


def partition(layout: Layout) -> None:
    """A wall that parts the room up to a gap, so that light comes around its end."""
    rng = layout.rng
    x, gap = layout.size[0] * rng.uniform(-0.2, 0.2), rng.uniform(0.8, 1.6)
    depth = layout.size[2] - gap
    wall = slab(0.1, layout.size[1], depth).at(x, 0, -gap / 2 * rng.choice([-1.0, 1.0]))
    layout.build("partition", [wall], np.eye(4))
    layout.reserve(np.stack([wall.points.min(axis=0), wall.points.max(axis=0)]))
    layout.walls += 1


def against_walls(layout: Layout, count: int) -> None:
    """Furniture with its back to a wall."""
    rng = layout.rng
    for name in rng.choice(AGAINST_WALLS, count):
        group = laden(rng, FURNITURE[str(name)](rng))
        for _ in range(8):
            wall = int(rng.integers(4))
            bounds, frame = group.bounds, wall_pose(wall, layout.size)
            half = wall_width(wall, layout.size) / 2
            free = half - bounds[1, 0]
            if free <= 0:
                continue
            place = frame @ [rng.uniform(-free, free), GAP, rng.uniform(0.03, 0.12) - bounds[0, 2], 1]
            motion = still(place[:3], wall * np.pi / 2)
            if layout.try_add(group, motion):
                layout.backs.append((motion, bounds))
                break


def motion_of(layout: Layout, x: float, z: float) -> RigidMotion:
    """A slow turn, a slide or hops, at a place."""
    rng, last = layout.rng, max(layout.frames - 1, 1)
    angle, start = rng.uniform(-np.pi, np.pi), np.array([x, GAP, z])
    turn, slide = rng.uniform(0.01, 0.06) * layout.frames, rng.uniform(0.005, 0.03) * layout.frames
    kind = rng.integers(3)
    if kind == 0:
        return RigidMotion(Track.constant(start), Track(np.array([angle, angle + turn * rng.choice([-1, 1])]), 0, last))
    heading = rng.uniform(-np.pi, np.pi)
    end = start + min(slide, 1.5) * np.array([np.cos(heading), 0, np.sin(heading)])
    if kind == 1:
        return RigidMotion(Track(np.stack([start, end]), 0, last), Track(np.array([angle, angle + turn / 2]), 0, last))
    up = np.array([0, rng.uniform(0.1, 0.5), 0])
    keys = np.stack([start, (start + end) / 2 + up, end, (start + end) / 2 + up, start])
    return RigidMotion(Track(np.maximum(keys, [-np.inf, GAP, -np.inf]), 0, 2 * last), Track.constant(angle))


def movers(layout: Layout, count: int) -> None:
    """Things that move rigidly, each in space of its own."""
    rng, makers = layout.rng, [*FURNITURE.values(), *DECOR.values()]
    goal = layout.moving + count
    for _ in range(12 * count):
        if layout.moving >= goal:
            return
        group = laden(rng, makers[int(rng.integers(len(makers)))](rng))
        half = layout.size[[0, 2]] / 2 - 0.2
        layout.try_add(group, motion_of(layout, *rng.uniform(-half, half)))


def scattered(layout: Layout, makers: Sequence[Maker], count: int) -> None:
    """Up to `count` things anywhere on the floor, turned any way."""
    rng, half = layout.rng, layout.size[[0, 2]] / 2 - 0.15
    for _ in range(count):
        group = laden(rng, makers[int(rng.integers(len(makers)))](rng))
        for _ in range(4):
            x, z = rng.uniform(-half, half)
            if layout.try_add(group, still((x, GAP, z), rng.uniform(-np.pi, np.pi))):
                break


def dining(layout: Layout) -> None:
    """A table with chairs that face it."""
    rng = layout.rng
    board = laden(rng, table(rng))
    half = layout.size[[0, 2]] / 2 - 1.0
    x, z = rng.uniform(-np.maximum(half, 0.1), np.maximum(half, 0.1))
    if not layout.try_add(board, still((x, GAP, z), rng.choice([0, np.pi / 2]))):
        return
    seat, (low, high) = chair(rng), layout.boxes[-1]
    for side in rng.permutation(4)[: rng.integers(1, 5)]:
        outward = np.array([np.sin(side * np.pi / 2), 0, np.cos(side * np.pi / 2)])
        reach = (high - low) / 2 + seat.bounds[1, 2] + rng.uniform(0.03, 0.25)
        place = np.array([(low[0] + high[0]) / 2, GAP, (low[2] + high[2]) / 2]) + outward * reach
        layout.try_add(Group.of(seat), still(place, side * np.pi / 2 + np.pi))


def pictures(layout: Layout, count: int) -> None:
    rng = layout.rng
    for _ in range(count):
        wall, art = int(rng.integers(4)), picture(rng)
        half = wall_width(wall, layout.size) / 2 + art.bounds[0, 0]
        top = layout.size[1] - art.bounds[1, 1] - 0.1
        if half > 0 and top > 0.8 and wall not in layout.openings:
            layout.hang(art, wall, rng.uniform(-half, half), rng.uniform(0.8, top), 0.004)


def shell(layout: Layout) -> list[Shape]:
    """Floor, ceiling and walls, whose openings are known by now."""
    rng, (width, height, depth) = layout.rng, layout.size
    below, above = floor(width + 0.1, depth + 0.1), floor(width + 0.1, depth + 0.1)
    above.apply_transform(np.array([[1, 0, 0, 0], [0, -1, 0, height], [0, 0, -1, 0], [0, 0, 0, 1.0]]))
    dark = rng.random() < 0.3  # shadows get their light from the walls: deep ones need dark walls
    wall_slot = "dark wall" if dark else "wall"
    tone = rng.uniform(0.02, 0.2, 3) if dark else rng.uniform(0.4, 0.85, 3)
    plain = {"type": "diffuse", "reflectance": {"type": "rgb", "value": tone.tolist()}}
    shapes = [Shape("floor", below, finish(rng, "floor", layout.gloss, 1.0)), Shape("ceiling", above, plain)]
    paint = finish(rng, wall_slot, layout.gloss / 3, 1.0)
    for wall in range(4):
        mesh = panel(wall_width(wall, layout.size) + 0.1, height, layout.openings.get(wall, []))
        mesh.apply_transform(wall_pose(wall, layout.size))
        own = finish(rng, wall_slot, layout.gloss / 3, 1.0) if rng.random() < 0.25 else paint
        shapes.append(Shape(f"wall-{wall}", mesh, own))
    return shapes


def lamps_of(layout: Layout, style: str) -> list[Lamp]:
    """The lamps that can be placed before the furniture."""
    rng = layout.rng
    small = (ceiling_panel, hanging, orb, standing_lamp)
    kinds = {"open": OPEN, "mixed": (*OPEN, *HIDDEN), "hidden": HIDDEN, "window": small}[style]
    wanted = {"open": (1, 4), "mixed": (1, 5), "hidden": (1, 3), "window": (0, 3)}[style]
    lamps: list[Lamp] = []
    count = int(rng.integers(*wanted))
    for _ in range(8 * count):
        if len(lamps) >= count:
            break
        lamps += kinds[int(rng.integers(len(kinds)))](layout)
    return lamps


STYLES = {"open": 0.5, "mixed": 0.15, "hidden": 0.06, "window": 0.29}


def room(rng: Rng, frames: int) -> Scene:
    """A random interior for a clip of `frames` frames, in metres: 15 to 60 things, 1 to 4 lamps or windows."""
    size = np.array([rng.uniform(3.2, 7.5), rng.uniform(2.3, 3.4), rng.uniform(3.2, 7.5)])
    layout = Layout(rng, size, frames, gloss=max(0.0, float(rng.uniform(-0.3, 0.5))))
    style = str(rng.choice(list(STYLES), p=list(STYLES.values())))
    outside = style == "window" and rng.random() < 0.5
    if style == "window":
        windows(layout, int(rng.integers(1, 4)))
    elif rng.random() < 0.15:
        partition(layout)
    eye = path(layout)
    way = len(layout.boxes)
    against_walls(layout, int(rng.integers(2, 8)))
    lamps = lamps_of(layout, style)
    if rng.random() < 0.5:
        movers(layout, int(rng.integers(2, 5)))
    if rng.random() < 0.6:
        dining(layout)
    scattered(layout, list(FURNITURE.values()), int(rng.integers(2, 8)))
    pictures(layout, int(rng.integers(0, 6)))
    scattered(layout, list(DECOR.values()), int(rng.integers(0, 8)))
    while layout.things < FEWEST:
        scattered(layout, list(DECOR.values()), FEWEST - layout.things)
    if style == "window" and not outside:
        panels = [sky_panel(layout, wall, hole) for wall, holes in layout.openings.items() for hole in holes]
        lamps = (lamps + panels)[:MOST_LAMPS]
    if not lamps and not outside:
        lamps = ceiling_panel(layout) or orb(layout) or hanging(layout)
    surface = 2 * (size[0] * size[1] + size[1] * size[2] + size[0] * size[2])
    shapes = [*shell(layout), *layout.shapes, *shine(layout, lamps, surface * float(rng.uniform(0.5, 2)))]
    glassy = any("dielectric" in shape.bsdf["type"] for shape in shapes)
    camera = look(layout, eye, layout.boxes[way:])
    sun = sun_through(rng, next(iter(layout.openings)), size) if rng.random() < 0.75 and layout.openings else None
    # The papers' one bounce after the first, or more, which fill shadows; light through solid glass takes two of them.
    depth = int(rng.choice([3, 4, 5], p=[0.5, 0.25, 0.25])) + 2 * glassy
    return Scene(tuple(shapes), camera, depth, sky(rng, sun) if outside else None)
