"""`room-N`, a random interior for any integer N, and `closeup-N`, a part of room-N through a longer lens."""

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scenes import lighting
from scenes.animation import Scene, Shape, Track
from scenes.boxes import bounding_box
from scenes.camera import Array, cross
from scenes.colours import diffuse_bsdf, rgb
from scenes.draws import Rng, log_uniform, one_of, uniforms
from scenes.finish import finish
from scenes.flight import aim_camera, flight_path
from scenes.furnishing import OWN_STOCK, against_walls, furnish
from scenes.layout import Layout
from scenes.meshes import Surface, horizontal_rectangle, join, sheet, slab
from scenes.objects.fittings import make_blind, make_curtain
from scenes.objects.thing import Stock
from scenes.textures import sky

MAX_LAMPS = 4
MIN_ZOOM, MAX_ZOOM = 1.5, 6.0  # of close-ups, times the room's focal length
OFF_CENTRE = 0.6  # of half of the room's image: the largest distance of a close-up from the middle


class Style(NamedTuple):
    """A way to light rooms."""

    share: float  # of all rooms
    fixtures: tuple[lighting.Fixture, ...]
    lamps: tuple[int, int]  # their number: from, to (exclusive)
    day: bool = False  # light enters through windows or missing walls
    missing_walls: tuple[int, int] = (0, 1)  # their number: from, to (exclusive)


# Chosen so that rooms are as hard to denoise as real interiors (docs/data.md).
STYLES = {
    "open": Style(0.24, lighting.OPEN_FIXTURES, (1, 4)),
    "luminous": Style(0.24, (lighting.luminous_panel,), (1, 4)),
    "terrace": Style(0.26, (lighting.luminous_panel, lighting.orb), (0, 2), day=True, missing_walls=(1, 4)),
    "window": Style(0.16, lighting.DAY_FIXTURES, (0, 3), day=True),
    "mixed": Style(0.08, (*lighting.OPEN_FIXTURES, *lighting.HIDDEN_FIXTURES), (1, 5)),
    "hidden": Style(0.02, lighting.HIDDEN_FIXTURES, (1, 3)),
}
ROOFLESS = 0.6  # share of the rooms with missing walls that have no ceiling either
NIGHT = 0.25  # share of the rooms lit by lamps alone that have windows, black outside


def reveal(opening: Array, thickness: float) -> Surface:
    """The four sides of an opening (2, 2) through a wall of that thickness, behind the plane z = 0."""
    border = 0.02
    (left, bottom), (right, top) = opening
    level = slab(right - left + 2 * border, border, thickness)
    upright = slab(border, top - bottom, thickness)
    sides = [level.at((left + right) / 2, y, -thickness / 2) for y in (bottom - border, top)]
    return join(sides + [upright.at(x, bottom, -thickness / 2) for x in (left - border / 2, right + border / 2)])


def add_windows(layout: Layout, count: int) -> None:
    """Add windows to `count` walls, some with blinds or curtains."""
    rng = layout.rng
    for wall in map(int, rng.permutation(4)[:count]):
        span = layout.wall_width(wall)
        width, height = uniforms(rng, (0.7, min(3.0, span - 0.6)), (0.7, layout.size[1] - 0.6))
        x, y = uniforms(rng, (-span / 2 + 0.25, span / 2 - 0.25 - width), (0.2, layout.size[1] - height - 0.2))
        hole = np.array([(x, y), (x + width, y + height)])
        layout.openings[wall] = [hole]
        layout.build("reveal", reveal(hole, rng.uniform(0.08, 0.3)), layout.wall_pose(wall))
        dressing = rng.random()
        if dressing < 0.2:
            layout.hang(make_blind(rng, width - 0.02, height - 0.02), wall, hole[:, 0].mean(), y + 0.01, -0.05)
        elif dressing < 0.45:
            cover = width * rng.uniform(0.3, 0.7)
            layout.hang(make_curtain(rng, cover, height + 0.2), wall, x + cover / 2, y - 0.1, 0.12)


def wall_with_openings(width: float, height: float, openings: list[Array]) -> Surface:
    """A rectangle in the xy plane on the origin, facing +z, with holes; texture coordinates in metres."""
    xs = np.unique([-width / 2, width / 2, *(x for opening in openings for x in opening[:, 0])])
    ys = np.unique([0.0, height, *(y for opening in openings for y in opening[:, 1])])
    cells = []
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
            if not any(((low < middle) & (middle < high)).all() for low, high in openings):
                points = np.array([[(x0, y0, 0), (x1, y0, 0)], [(x0, y1, 0), (x1, y1, 0)]])
                cells.append(sheet(points, points[..., :2]))
    return join(cells)


def shell(layout: Layout) -> list[Shape]:
    rng = layout.rng
    width, height, depth = layout.size
    level = horizontal_rectangle(width + 0.1, depth + 0.1)
    dark = rng.random() < 0.3  # for deep shadows, which are lit by the walls
    slot = "dark wall" if dark else "wall"
    tone = rng.uniform(0.02, 0.2, 3) if dark else rng.uniform(0.4, 0.85, 3)
    roofless = bool(layout.missing_walls) and rng.random() < ROOFLESS
    shapes = [Shape("floor", level.mesh(), finish(rng, "floor", layout.gloss, 1.0))]
    if not roofless:
        above = np.array([[1, 0, 0, 0], [0, -1, 0, height], [0, 0, -1, 0], [0, 0, 0, 1.0]])
        shapes.append(Shape("ceiling", level.mesh(above), diffuse_bsdf(rgb(tone.tolist()))))
    paint = finish(rng, slot, layout.gloss / 3, 1.0)
    for wall in sorted(set(range(4)) - layout.missing_walls):
        surface = wall_with_openings(layout.wall_width(wall) + 0.1, height, layout.openings.get(wall, []))
        own = finish(rng, slot, layout.gloss / 3, 1.0) if rng.random() < 0.25 else paint
        shapes.append(Shape(f"wall-{wall}", surface.mesh(layout.wall_pose(wall)), own))
    return shapes


def holes(layout: Layout, style: Style) -> None:
    """Missing walls, windows or a partition, as the style requires."""
    rng = layout.rng
    if style.missing_walls[1] > 1:
        count = int(rng.integers(*style.missing_walls))
        for wall in map(int, rng.permutation(4)[:count]):
            span = layout.wall_width(wall)
            layout.missing_walls.add(wall)
            layout.openings[wall] = [np.array([(-span / 2, 0.0), (span / 2, layout.size[1])])]
    elif style.day or rng.random() < NIGHT:
        add_windows(layout, int(rng.integers(1, 4)))
    elif rng.random() < 0.15:  # a wall that divides the room up to a gap
        width, height, depth = layout.size
        aside, gap = uniforms(rng, (-0.2, 0.2), (0.8, 1.6))
        divider = slab(0.1, height, depth - gap).at(width * aside, 0, -gap / 2 * rng.choice([-1.0, 1.0]))
        layout.build("partition", divider)
        layout.reserve(bounding_box(divider.points))
        layout.walls += 1


def outside(layout: Layout, style: Style) -> Array | None:
    """The sky around the room: by day in half of the rooms with windows, and wherever walls are missing."""
    rng = layout.rng
    if not style.day or (not layout.missing_walls and rng.random() < 0.5):
        return None
    if rng.random() >= (0.3 if layout.missing_walls else 0.75):
        return sky(rng, sun=None)
    aside, elevation = uniforms(rng, (-1, 1), (0.2, 1.0))
    through = layout.wall_pose(next(iter(layout.openings)))[:3, :3]
    return sky(rng, sun=through @ [np.sin(aside), np.tan(elevation), -np.cos(aside)])


def room(rng: Rng, frames: int, stock: Stock = OWN_STOCK) -> Scene:
    """A random interior for a clip of `frames` frames, in metres: 15 to 60 things, 1 to 4 lamps or windows."""
    size = np.array([rng.uniform(3.2, 7.5), rng.uniform(2.3, 3.4), rng.uniform(3.2, 7.5)])
    layout = Layout(rng, size, frames, max(0.0, float(rng.uniform(*stock.gloss))), stock)
    style = STYLES[str(rng.choice(list(STYLES), p=[style.share for style in STYLES.values()]))]
    holes(layout, style)
    environment = outside(layout, style)
    eye = flight_path(layout)
    way = len(layout.boxes)
    against_walls(layout, int(rng.integers(2, 8)))
    lamps: list[Shape] = []
    count = int(rng.integers(*style.lamps))
    for _ in range(8 * count):
        if len(lamps) < count:
            lamps += one_of(rng, style.fixtures)(layout)
    furnish(layout)
    if style.day and environment is None:
        for wall, openings in layout.openings.items():
            for opening in openings:
                lamps += lighting.sky_panel(layout, wall, opening)
        lamps = lamps[:MAX_LAMPS]
    if not lamps and environment is None:
        lamps = lighting.ceiling_panel(layout) or lighting.orb(layout) or lighting.hanging(layout)
    surface = 2 * (size[0] * size[1] + size[1] * size[2] + size[0] * size[2])
    shapes = [*shell(layout), *layout.shapes, *lighting.shine(layout, lamps, surface * float(rng.uniform(0.5, 2)))]
    glassy = any("dielectric" in shape.bsdf["type"] for shape in shapes)
    camera = aim_camera(layout, eye, layout.boxes[way:])
    # One indirect bounce as in the papers, or more; solid glass takes two more.
    depth = int(rng.choice([3, 4, 5], p=[0.5, 0.25, 0.25])) + 2 * glassy
    return Scene(tuple(shapes), camera, depth, environment)


def closeup(rng: Rng, frames: int, stock: Stock = OWN_STOCK) -> Scene:
    """A random room through a longer lens, as finely resolved as in an image several times as wide."""
    scene = room(rng, frames, stock)
    camera = scene.camera
    zoom = log_uniform(rng, MIN_ZOOM, MAX_ZOOM)
    across, up = rng.uniform(-OFF_CENTRE, OFF_CENTRE, 2)  # to the right and upwards, in half image widths
    half_width = np.tan(np.radians(camera.x_fov.at(0)) / 2)
    targets = []
    for frame in range(frames):
        ahead = camera.target.at(frame) - camera.eye.at(frame)
        right = cross(ahead, camera.up.at(frame))
        right *= np.linalg.norm(ahead) / np.linalg.norm(right)
        above = cross(right, ahead) / np.linalg.norm(ahead)
        targets.append(camera.target.at(frame) + half_width * (across * right + up * above))
    fov = 2 * np.degrees(np.arctan(half_width / zoom))
    target = Track(np.stack(targets), 0, frames - 1)
    return replace(scene, camera=replace(camera, target=target, x_fov=Track.constant(float(fov))))
