"""Lamps for rooms, from plain panels to indirect lighting.

A fixture adds its body to the layout and returns its lamp in a list, empty if it does not fit; `shine` lights it.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import trimesh

from scenes.animation import AT_REST, KeyframedTrack, RigidMotion, Shape, Track, still
from scenes.boxes import bounding_box, transformed_box
from scenes.camera import Array
from scenes.colours import diffuse_bsdf, light_colour, rgb
from scenes.draws import log_uniform, one_of, uniforms
from scenes.layout import GAP, Layout
from scenes.meshes import Surface, horizontal_rectangle, join, lathe, slab, superellipsoid
from scenes.objects.fittings import make_floor_lamp, make_pendant
from scenes.objects.thing import Thing

BLACK = diffuse_bsdf(rgb([0.05, 0.05, 0.05]))


def turn_then_shift(angle: float, x: float, y: float, z: float) -> Array:
    """The matrix (4, 4) of a rotation by `angle` radians about the x axis, then a translation."""
    turn = trimesh.transformations.rotation_matrix(angle, (1, 0, 0))
    return np.asarray(trimesh.transformations.translation_matrix((x, y, z)) @ turn)


def lamp(surface: Surface, *poses: Array, motion: RigidMotion = AT_REST) -> list[Shape]:
    """A surface that is to shine, transformed by each of the `poses` (4, 4)."""
    return [Shape("lamp", surface.mesh(*poses), BLACK, motion=motion)]


def panel_below_ceiling(layout: Layout, width: float, depth: float) -> list[Shape]:
    x, _, z = layout.floor_position(max(width, depth) / 2 + 0.05)
    y = layout.size[1] - 0.02
    box = np.array([[x - width / 2, y - 0.01, z - depth / 2], [x + width / 2, y + 0.01, z + depth / 2]])
    panel = lamp(horizontal_rectangle(width, depth), turn_then_shift(np.pi, x, y, z))
    return panel if layout.claim(box) else []


def ceiling_panel(layout: Layout) -> list[Shape]:
    """A panel as small as a spotlight or as large as a table."""
    return panel_below_ceiling(layout, log_uniform(layout.rng, 0.2, 2.5), log_uniform(layout.rng, 0.2, 2.5))


def luminous_panel(layout: Layout) -> list[Shape]:
    """A panel of up to half of the ceiling, as in offices and shops."""
    return panel_below_ceiling(layout, *(layout.rng.uniform(0.25, 0.7, 2) * layout.size[[0, 2]]).tolist())


def downlight(layout: Layout) -> list[Shape]:
    """A lamp deep in a dark tube under the ceiling: a spot of light."""
    rng = layout.rng
    radius = log_uniform(rng, 0.05, 0.15)
    tall = radius * rng.uniform(0.7, 2.0)
    x, _, z = layout.floor_position(0.5)
    y = layout.size[1] - tall - 0.01
    box = np.array([[x - radius, y - GAP, z - radius], [x + radius, y + tall, z + radius]])
    if not layout.claim(box):
        return []
    tube = lathe([(radius * 0.9, 0), (radius, 0), (radius, tall), (radius * 0.9, tall), (radius * 0.9, 0)], 24)
    layout.build("tube", tube.at(x, y, z), bsdf=BLACK)
    return lamp(horizontal_rectangle(radius, radius), turn_then_shift(np.pi, x, y + tall * 0.95, z))


def bulb(thing: Thing, radius: float, motion: RigidMotion) -> list[Shape]:
    """A ball in the middle of a thing's shade."""
    x, y, z = bounding_box(thing.parts["shade"].points).mean(axis=0)
    ball = superellipsoid(2 * radius, 2 * radius, 2 * radius, 2, 1)
    return lamp(ball.at(x, y - radius, z), motion=motion)


def hanging(layout: Layout) -> list[Shape]:
    """A pendant with a bulb in its shade; a closed shade emits light itself instead."""
    thing = make_pendant(layout.rng)
    x, _, z = layout.floor_position(0.5)
    motion = still((x, layout.size[1] - thing.bounds[1, 1] - GAP, z), 0.0)
    shade = thing.parts["shade"]
    closed = trimesh.Trimesh(shade.points, shade.faces).is_watertight
    light = lamp(shade, motion=motion) if closed else bulb(thing, log_uniform(layout.rng, 0.04, 0.1), motion)
    kept = Thing(thing.name, {"metal": thing.parts["metal"]}) if closed else thing
    if not layout.claim(transformed_box(thing.bounds, motion.matrix(0))):
        return []
    layout.add([(kept, np.eye(4))], motion)
    return light


def standing_lamp(layout: Layout) -> list[Shape]:
    """A floor lamp whose bulb is hidden in its shade."""
    thing = make_floor_lamp(layout.rng)
    motion = still(layout.floor_position(0.4), float(layout.rng.uniform(-np.pi, np.pi)))
    fits = layout.try_add([(thing, np.eye(4))], motion)
    return bulb(thing, log_uniform(layout.rng, 0.02, 0.06), motion) if fits else []


def orb(layout: Layout) -> list[Shape]:
    """A glowing ball in the air, in half of the cases moving."""
    rng = layout.rng
    radius = log_uniform(rng, 0.06, 0.3)
    start = layout.floor_position(0.4)
    start[1] = rng.uniform(0.3, layout.size[1] - 0.5)
    drift = rng.uniform(-0.4, 0.4, 3) * (rng.random() < 0.5)
    motion = RigidMotion(Track(np.stack([start, start + drift]), 0, layout.last_frame), Track.constant(0.0))
    ball = superellipsoid(2 * radius, 2 * radius, 2 * radius, 2, 2)
    fits = layout.claim(layout.swept(bounding_box(ball.points), motion))
    return lamp(ball, motion=motion) if fits else []


def cove(layout: Layout) -> list[Shape]:
    """A strip behind a ledge under the ceiling, visible from the ceiling only."""
    rng = layout.rng
    wall = int(rng.integers(4))
    length = layout.wall_width(wall) * rng.uniform(0.4, 0.9)
    drop, depth, lip = uniforms(rng, (0.2, 0.4), (0.12, 0.25), (0.05, 0.12))
    y = layout.size[1] - drop
    frame = layout.wall_pose(wall)
    ledge = join([slab(length, 0.03, depth).at(0, y - 0.03, depth / 2), slab(length, lip, 0.02).at(0, y, depth - 0.01)])
    box = transformed_box(np.array([[-length / 2, y - 0.03, 0.001], [length / 2, y + lip, depth]]), frame)
    if not layout.claim(box):
        return []
    layout.build("ledge", ledge, frame)
    return lamp(horizontal_rectangle(length * 0.95, 0.08).at(0, y + 0.005, depth * 0.4), frame)


def behind_opening(layout: Layout) -> list[Shape]:
    """A panel outside a wall with slits or a small hole."""
    rng = layout.rng
    wall = int(rng.integers(4))
    if wall in layout.openings:
        return []
    width = layout.wall_width(wall)
    if rng.random() < 0.6:  # parallel slits
        count = int(rng.integers(1, 6))
        thin, tall = uniforms(rng, (0.1, 0.3), (0.6, 1.6))
        span = count * 0.25
    else:
        count = 1
        span = thin = tall = rng.uniform(0.2, 0.6)
    start, y = uniforms(rng, (-width / 2 + 0.3, width / 2 - 0.3 - span), (0.2, layout.size[1] - tall - 0.2))
    layout.openings[wall] = [np.array([(x, y), (x + thin, y + tall)]) for x in start + 0.25 * np.arange(count)]
    x, y = layout.openings[wall][0].mean(axis=0)
    size, away = uniforms(rng, (0.5, 1.5), (0.1, 0.4))
    shift = (x + rng.uniform(-0.3, 0.3), y + rng.uniform(-0.3, 0.5), -away)
    return lamp(horizontal_rectangle(size, size), turn_then_shift(np.pi / 2, *shift), layout.wall_pose(wall))


def above_furniture(layout: Layout) -> list[Shape]:
    """A strip on top of furniture at a wall, near its back, facing up or the wall."""
    if not layout.backs:
        return []
    motion, box = one_of(layout.rng, layout.backs)
    width, height, depth = box[1] - box[0]
    place = turn_then_shift(-layout.rng.uniform(0, np.pi / 3), 0, height + 0.08, box[0, 2] + depth / 4)
    return lamp(horizontal_rectangle(width * 0.7, min(0.08, depth / 3)), place, motion=motion)


def sky_panel(layout: Layout, wall: int, opening: Array) -> list[Shape]:
    """An overcast sky: a bright rectangle behind a window (2, 2), with its edges hidden."""
    x, y = opening.mean(axis=0)
    panel = horizontal_rectangle(*(opening[1] - opening[0] + 0.8))
    return lamp(panel, turn_then_shift(np.pi / 2, x, y, -0.35), layout.wall_pose(wall))


Fixture = Callable[[Layout], list[Shape]]

OPEN_FIXTURES: tuple[Fixture, ...] = (*[ceiling_panel] * 4, downlight, hanging, orb)
DAY_FIXTURES: tuple[Fixture, ...] = (luminous_panel, ceiling_panel, hanging, orb, standing_lamp)
HIDDEN_FIXTURES: tuple[Fixture, ...] = (cove, behind_opening, above_furniture, standing_lamp)


def brightness(layout: Layout) -> Track:
    """A factor over time: 1 for most lamps; one in eight fades, one in eight is switched between two frames."""
    rng = layout.rng
    kind = rng.random()
    if kind < 1 / 8:
        return Track(rng.uniform(0.3, 1.0, int(rng.integers(2, 5))), 0, layout.last_frame)
    if kind < 1 / 4 and layout.frames > 1:
        before = int(rng.integers(layout.frames - 1))
        levels = rng.permutation([1.0, log_uniform(rng, 0.01, 0.2)])
        return KeyframedTrack(levels, times=np.array([before, before + 1.0]), straight=True)
    return Track.constant(1.0)


def shine(layout: Layout, lamps: list[Shape], flux: float) -> list[Shape]:
    """The lamps, switched on: together they emit `flux` (pi times area times radiance), in random shares."""
    rng = layout.rng
    shares = rng.lognormal(0, 0.8, len(lamps))
    shapes = []
    for number, (light, share) in enumerate(zip(lamps, shares / shares.sum(), strict=True)):
        strength = brightness(layout)
        radiance = light_colour(rng) * share * flux / (np.pi * light.mesh.area)
        track = replace(strength, keys=np.outer(strength.keys, radiance))
        shapes.append(replace(light, name=f"lamp-{number}", radiance=track))
    return shapes
