"""`room-N`: any number is another interior, with its own furniture, materials, lights, motions and camera flight."""

from typing import NamedTuple

import numpy as np

from scenes.animation import Scene, Shape
from scenes.bsdf import diffuse_bsdf, rgb
from scenes.camera import Array
from scenes.draws import Rng, one_of
from scenes.finish import finish
from scenes.flight import aim_camera, flight_path
from scenes.furnishing import against_walls, furnish
from scenes.layout import Layout
from scenes.lighting import (
    HIDDEN,
    OPEN,
    Fixture,
    Lamp,
    ceiling_panel,
    hanging,
    luminous_panel,
    orb,
    shine,
    sky_panel,
    standing_lamp,
)
from scenes.meshes import slab
from scenes.objects.window_dressing import make_blind, make_curtain
from scenes.shell import Opening, horizontal_rectangle, reveal, wall_pose, wall_width, wall_with_openings
from scenes.sky import sky, sun_through

MAX_LAMPS = 4


class Style(NamedTuple):
    """How rooms are lit."""

    share: float  # of all rooms
    fixtures: tuple[Fixture, ...]
    lamps: tuple[int, int]  # how many are tried: from, to below
    day: bool = False  # light comes in through windows, or where walls are missing
    missing_walls: tuple[int, int] = (0, 1)  # how many: from, to below


# Shares and fixtures are such that the light of rooms is as hard to denoise as that of real interiors (docs/data.md).
STYLES = {
    "open": Style(0.24, OPEN, (1, 4)),
    "luminous": Style(0.24, (luminous_panel,), (1, 4)),
    "terrace": Style(0.26, (luminous_panel, orb), (0, 2), day=True, missing_walls=(1, 4)),
    "window": Style(0.16, (luminous_panel, ceiling_panel, hanging, orb, standing_lamp), (0, 3), day=True),
    "mixed": Style(0.08, (*OPEN, *HIDDEN), (1, 5)),
    "hidden": Style(0.02, HIDDEN, (1, 3)),
}
ROOFLESS = 0.6  # share of the rooms without some walls that have no ceiling either
NIGHT = 0.25  # share of the rooms lit by lamps alone that have windows, black outside


def windows(layout: Layout, count: int) -> None:
    """Openings to the sky in `count` walls, some behind blinds or curtains."""
    rng = layout.rng
    for wall in map(int, rng.permutation(4)[:count]):
        span = wall_width(wall, layout.size)
        width = rng.uniform(0.7, min(3.0, span - 0.6))
        height = rng.uniform(0.7, layout.size[1] - 0.6)
        x = rng.uniform(-span / 2 + 0.25, span / 2 - 0.25 - width)
        y = rng.uniform(0.2, layout.size[1] - height - 0.2)
        hole = Opening((x, y), (x + width, y + height))
        layout.openings[wall] = [hole]
        layout.build("reveal", [reveal(hole, rng.uniform(0.08, 0.3))], wall_pose(wall, layout.size))
        dressing = rng.random()
        if dressing < 0.2:
            layout.hang(make_blind(rng, width - 0.02, height - 0.02), wall, hole.middle[0], y + 0.01, -0.05)
        elif dressing < 0.45:
            cover = width * rng.uniform(0.3, 0.7)
            layout.hang(make_curtain(rng, cover, height + 0.2), wall, x + cover / 2, y - 0.1, 0.12)


def without_walls(layout: Layout, count: int) -> None:
    """Leave out `count` walls."""
    for wall in map(int, layout.rng.permutation(4)[:count]):
        span = wall_width(wall, layout.size)
        layout.missing_walls.add(wall)
        layout.openings[wall] = [Opening((-span / 2, 0.0), (span / 2, float(layout.size[1])))]


def partition(layout: Layout) -> None:
    """A wall that parts the room up to a gap, so that light comes around its end."""
    rng = layout.rng
    x = layout.size[0] * rng.uniform(-0.2, 0.2)
    gap = rng.uniform(0.8, 1.6)
    depth = layout.size[2] - gap
    wall = slab(0.1, layout.size[1], depth).at(x, 0, -gap / 2 * rng.choice([-1.0, 1.0]))
    layout.build("partition", [wall], np.eye(4))
    layout.reserve(np.stack([wall.points.min(axis=0), wall.points.max(axis=0)]))
    layout.walls += 1


def shell(layout: Layout) -> list[Shape]:
    """Floor, ceiling and walls, whose openings are known by now."""
    rng = layout.rng
    width, height, depth = layout.size
    below = horizontal_rectangle(width + 0.1, depth + 0.1)
    above = horizontal_rectangle(width + 0.1, depth + 0.1)
    above.apply_transform(np.array([[1, 0, 0, 0], [0, -1, 0, height], [0, 0, -1, 0], [0, 0, 0, 1.0]]))
    dark = rng.random() < 0.3  # shadows get their light from the walls: deep ones need dark walls
    slot = "dark wall" if dark else "wall"
    tone = rng.uniform(0.02, 0.2, 3) if dark else rng.uniform(0.4, 0.85, 3)
    roofless = bool(layout.missing_walls) and rng.random() < ROOFLESS
    shapes = [
        Shape("floor", below, finish(rng, "floor", layout.gloss, 1.0)),
        *([] if roofless else [Shape("ceiling", above, diffuse_bsdf(rgb(tone.tolist())))]),
    ]
    paint = finish(rng, slot, layout.gloss / 3, 1.0)
    for wall in sorted(set(range(4)) - layout.missing_walls):
        mesh = wall_with_openings(wall_width(wall, layout.size) + 0.1, height, layout.openings.get(wall, []))
        mesh.apply_transform(wall_pose(wall, layout.size))
        own = finish(rng, slot, layout.gloss / 3, 1.0) if rng.random() < 0.25 else paint
        shapes.append(Shape(f"wall-{wall}", mesh, own))
    return shapes


def lamps_of(layout: Layout, style: Style) -> list[Lamp]:
    """Lamps that are placed before most of the furniture."""
    rng = layout.rng
    lamps: list[Lamp] = []
    count = int(rng.integers(*style.lamps))
    for _ in range(8 * count):
        if len(lamps) >= count:
            break
        lamps += one_of(rng, style.fixtures)(layout)
    return lamps


def holes(layout: Layout, style: Style) -> None:
    """What is missing of the walls, or parts the room: openings to the day, windows at night, a partition."""
    rng = layout.rng
    if style.missing_walls[1] > 1:
        without_walls(layout, int(rng.integers(*style.missing_walls)))
    elif style.day or rng.random() < NIGHT:
        windows(layout, int(rng.integers(1, 4)))
    elif rng.random() < 0.15:
        partition(layout)


def outside(layout: Layout, style: Style) -> Array | None:
    """The sky around the room, in half of the rooms with windows by day; always where walls are missing."""
    rng = layout.rng
    if not style.day or (not layout.missing_walls and rng.random() < 0.5):
        return None
    sunny = rng.random() < (0.3 if layout.missing_walls else 0.75)
    sun = sun_through(rng, next(iter(layout.openings)), layout.size) if sunny else None
    return sky(rng, sun)


def room(rng: Rng, frames: int) -> Scene:
    """A random interior for a clip of `frames` frames, in metres: 15 to 60 things, 1 to 4 lamps or windows."""
    size = np.array([rng.uniform(3.2, 7.5), rng.uniform(2.3, 3.4), rng.uniform(3.2, 7.5)])
    layout = Layout(rng, size, frames, gloss=max(0.0, float(rng.uniform(-0.3, 0.5))))
    style = STYLES[str(rng.choice(list(STYLES), p=[style.share for style in STYLES.values()]))]
    holes(layout, style)
    around = outside(layout, style)
    eye = flight_path(layout)
    way = len(layout.boxes)
    against_walls(layout, int(rng.integers(2, 8)))
    lamps = lamps_of(layout, style)
    furnish(layout)
    if style.day and around is None:
        panels = [sky_panel(layout, wall, hole) for wall, openings in layout.openings.items() for hole in openings]
        lamps = (lamps + panels)[:MAX_LAMPS]
    if not lamps and around is None:
        lamps = ceiling_panel(layout) or orb(layout) or hanging(layout)
    surface = 2 * (size[0] * size[1] + size[1] * size[2] + size[0] * size[2])
    shapes = [*shell(layout), *layout.shapes, *shine(layout, lamps, surface * float(rng.uniform(0.5, 2)))]
    glassy = any("dielectric" in shape.bsdf["type"] for shape in shapes)
    camera = aim_camera(layout, eye, layout.boxes[way:])
    # The papers' one bounce after the first, or more, which fill shadows; light through solid glass takes two of them.
    depth = int(rng.choice([3, 4, 5], p=[0.5, 0.25, 0.25])) + 2 * glassy
    return Scene(tuple(shapes), camera, depth, around)
