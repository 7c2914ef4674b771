"""Lamps and skies for rooms, from plain panels to light that only arrives around corners.

A fixture adds its body to the layout and returns the lamps in it. How strong they are is decided when all are known.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from scenes.animation import Array, RigidMotion, Shape, Track
from scenes.finish import log_uniform
from scenes.layout import GAP, Group, Layout, box_of
from scenes.meshes import lathe, pad, slab
from scenes.objects import Thing, floor_lamp, pendant
from scenes.shell import Opening, floor, still, wall_pose, wall_width

Rng = np.random.Generator


BLACK = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.05, 0.05, 0.05]}}


@dataclass(frozen=True)
class Lamp:
    """A mesh that shines, moving with what it belongs to."""

    mesh: trimesh.Trimesh
    motion: RigidMotion

    def shape(self, number: int, radiance: Track) -> Shape:
        return Shape(f"lamp-{number}", self.mesh, BLACK, radiance, self.motion)


HERE = still((0, 0, 0), 0)


def moved(mesh: trimesh.Trimesh, matrix: Array) -> trimesh.Trimesh:
    mesh.apply_transform(matrix)
    return mesh


def turned(axis: int, angle: float, x: float, y: float, z: float) -> Array:
    """A turn about the x, y or z axis (0, 1, 2), then a shift."""
    matrix = np.asarray(trimesh.transformations.rotation_matrix(angle, np.eye(3)[axis]))
    matrix[:3, 3] = x, y, z
    return matrix


def spot(layout: Layout, margin: float) -> tuple[float, float]:
    """A random place (x, z) at least `margin` from the walls."""
    half = np.maximum(layout.size[[0, 2]] / 2 - margin, 0.01)
    x, z = layout.rng.uniform(-half, half)
    return float(x), float(z)


def ceiling_panel(layout: Layout) -> list[Lamp]:
    """A rectangle below the ceiling that shines down, from a spotlight's size to a big panel."""
    rng = layout.rng
    width, depth = log_uniform(rng, 0.2, 2.5), log_uniform(rng, 0.2, 2.5)
    x, z = spot(layout, max(width, depth) / 2 + 0.05)
    y = layout.size[1] - 0.02
    box = np.array([[x - width / 2, y - 0.01, z - depth / 2], [x + width / 2, y + 0.01, z + depth / 2]])
    if not layout.fits(box):
        return []
    layout.reserve(box)
    return [Lamp(moved(floor(width, depth), turned(0, np.pi, x, y, z)), HERE)]


def downlight(layout: Layout) -> list[Lamp]:
    """A lamp deep in a dark tube under the ceiling: a bright pool of light, the rest in shadow."""
    rng, radius = layout.rng, log_uniform(layout.rng, 0.05, 0.15)
    tall, (x, z) = radius * rng.uniform(0.7, 2.0), spot(layout, 0.5)
    y = layout.size[1] - tall - 0.01
    box = np.array([[x - radius, y - GAP, z - radius], [x + radius, y + tall, z + radius]])
    if not layout.fits(box):
        return []
    layout.reserve(box)
    tube = lathe([(radius * 0.9, 0), (radius, 0), (radius, tall), (radius * 0.9, tall), (radius * 0.9, 0)], 24)
    layout.build("tube", [tube], turned(1, 0, x, y, z), BLACK)
    return [Lamp(moved(floor(radius, radius), turned(0, np.pi, x, y + tall * 0.95, z)), HERE)]


def bulb(thing: Thing, radius: float, motion: RigidMotion) -> Lamp:
    """A glowing ball in the middle of the thing's shade, or the shade itself where that is a closed ball."""
    shade = next(part.mesh for part in thing.parts if part.slot == "shade")
    low, high = shade.bounds
    x, y, z = (low + high) / 2
    return Lamp(moved(pad(2 * radius, 2 * radius, 2 * radius, 2, 1).mesh(), turned(1, 0, x, y - radius, z)), motion)


def hanging(layout: Layout) -> list[Lamp]:
    """A pendant with a bulb in its shade; glows around where the shade is a closed ball."""
    thing = pendant(layout.rng)
    x, z = spot(layout, 0.5)
    motion = still((x, layout.size[1] - thing.bounds[1, 1] - GAP, z), 0.0)
    shade = next(part for part in thing.parts if part.slot == "shade")
    closed = trimesh.Trimesh(shade.mesh.vertices, shade.mesh.faces).is_watertight
    lamp = Lamp(shade.mesh, motion) if closed else bulb(thing, log_uniform(layout.rng, 0.04, 0.1), motion)
    kept = Thing(thing.name, tuple(part for part in thing.parts if part is not shade or not closed))
    if not layout.fits(box_of(thing.bounds, motion.matrix(0))):
        return []
    layout.add(Group.of(kept), motion)
    layout.reserve(box_of(thing.bounds, motion.matrix(0)))
    return [lamp]


def standing_lamp(layout: Layout) -> list[Lamp]:
    """A floor lamp whose bulb is hidden in its shade."""
    thing = floor_lamp(layout.rng)
    motion = still(np.insert(spot(layout, 0.4), 1, GAP), float(layout.rng.uniform(-np.pi, np.pi)))
    if not layout.try_add(Group.of(thing), motion):
        return []
    return [bulb(thing, log_uniform(layout.rng, 0.02, 0.06), motion)]


def orb(layout: Layout) -> list[Lamp]:
    """A glowing ball in the air, which in half of the cases drifts."""
    rng, radius = layout.rng, log_uniform(layout.rng, 0.06, 0.3)
    (x, z), y = spot(layout, 0.4), rng.uniform(0.3, layout.size[1] - 0.5)
    drift = rng.uniform(-0.4, 0.4, 3) * (rng.random() < 0.5)
    start = np.array([x, y, z])
    motion = RigidMotion(Track(np.stack([start, start + drift]), 0, max(layout.frames - 1, 1)), Track.constant(0.0))
    mesh = pad(2 * radius, 2 * radius, 2 * radius, 2, 2).mesh()
    box = layout.swept(np.asarray(mesh.bounds), motion)
    if not layout.fits(box):
        return []
    layout.reserve(box)
    return [Lamp(mesh, motion)]


def cove(layout: Layout) -> list[Lamp]:
    """A strip behind a ledge under the ceiling: only the ceiling sees it."""
    rng, wall = layout.rng, int(layout.rng.integers(4))
    length = wall_width(wall, layout.size) * rng.uniform(0.4, 0.9)
    drop, depth, lip = rng.uniform(0.2, 0.4), rng.uniform(0.12, 0.25), rng.uniform(0.05, 0.12)
    y, frame = layout.size[1] - drop, wall_pose(wall, layout.size)
    ledge = [slab(length, 0.03, depth).at(0, y - 0.03, depth / 2), slab(length, lip, 0.02).at(0, y, depth - 0.01)]
    box = box_of(np.array([[-length / 2, y - 0.03, 0.001], [length / 2, y + lip, depth]]), frame)
    if not layout.fits(box):
        return []
    layout.reserve(box)
    layout.build("ledge", ledge, frame)
    strip = floor(length * 0.95, 0.08)
    return [Lamp(moved(moved(strip, turned(1, 0, 0, y + 0.005, depth * 0.4)), frame), HERE)]


def behind_opening(layout: Layout) -> list[Lamp]:
    """A panel outside that shines in through slits or a small hole in a wall."""
    rng, wall = layout.rng, int(layout.rng.integers(4))
    if wall in layout.openings:
        return []
    width, height = wall_width(wall, layout.size), layout.size[1]
    if rng.random() < 0.6:  # parallel slits
        count, thin, tall = int(rng.integers(1, 6)), rng.uniform(0.1, 0.3), rng.uniform(0.6, 1.6)
        start, y = rng.uniform(-width / 2 + 0.3, width / 2 - 0.3 - count * 0.25), rng.uniform(0.2, height - tall - 0.2)
        holes = [Opening((start + 0.25 * i, y), (start + 0.25 * i + thin, y + tall)) for i in range(count)]
    else:
        side = rng.uniform(0.2, 0.6)
        x, y = rng.uniform(-width / 2 + 0.3, width / 2 - 0.3 - side), rng.uniform(0.2, height - side - 0.2)
        holes = [Opening((x, y), (x + side, y + side))]
    layout.openings[wall] = holes
    x, y = holes[0].middle
    size, away = rng.uniform(0.5, 1.5), rng.uniform(0.1, 0.4)
    shift = x + rng.uniform(-0.3, 0.3), y + rng.uniform(-0.3, 0.5), -away
    lamp = moved(floor(size, size), turned(0, np.pi / 2, *shift))
    return [Lamp(moved(lamp, wall_pose(wall, layout.size)), HERE)]


def above_furniture(layout: Layout) -> list[Lamp]:
    """A strip on top of something before a wall, near its back, that shines up or at the wall."""
    if not layout.backs:
        return []
    motion, box = layout.backs[int(layout.rng.integers(len(layout.backs)))]
    width, height, depth = box[1] - box[0]
    strip = floor(width * 0.7, min(0.08, depth / 3))
    tilt = -layout.rng.uniform(0, np.pi / 3)
    return [Lamp(moved(strip, turned(0, tilt, 0, height + 0.08, box[0, 2] + depth / 4)), motion)]


def sky_panel(layout: Layout, wall: int, opening: Opening) -> Lamp:
    """An overcast sky: a bright rectangle right behind a window, large enough to hide its own edges."""
    panel = moved(floor(opening.width + 0.8, opening.height + 0.8), turned(0, np.pi / 2, *opening.middle, -0.35))
    return Lamp(moved(panel, wall_pose(wall, layout.size)), HERE)


Fixture = Callable[[Layout], list[Lamp]]

OPEN: tuple[Fixture, ...] = (ceiling_panel, ceiling_panel, ceiling_panel, ceiling_panel, downlight, hanging, orb)
HIDDEN: tuple[Fixture, ...] = (cove, behind_opening, above_furniture, standing_lamp)

LIGHT_COLOURS = np.array([[1.0, 0.55, 0.25], [1.0, 0.75, 0.5], [1.0, 0.95, 0.85], [0.8, 0.9, 1.0]])  # candle to shade


def light_colour(rng: Rng) -> Array:
    """Colour of a lamp, of luminance about 1: mostly on the way from candle light to daylight, sometimes any hue."""
    if rng.random() < 0.15:
        hue = rng.dirichlet(np.ones(3))
        return np.asarray(hue / hue.max())
    position = rng.uniform(0, len(LIGHT_COLOURS) - 1)
    return np.stack([np.interp(position, range(len(LIGHT_COLOURS)), channel) for channel in LIGHT_COLOURS.T])


def brightness(rng: Rng, frames: int) -> Track:
    """A factor over time: mostly 1, in one of eight lamps fading, in some of these several times."""
    if rng.random() > 1 / 8:
        return Track.constant(1.0)
    return Track(rng.uniform(0.3, 1.0, int(rng.integers(2, 5))), 0, max(frames - 1, 1))


def shine(layout: Layout, lamps: list[Lamp], flux: float) -> list[Shape]:
    """The lamps as shapes that give `flux` (radiance times area times pi) together, unevenly shared."""
    rng = layout.rng
    shares = rng.lognormal(0, 0.8, len(lamps))
    shapes = []
    for number, (lamp, share) in enumerate(zip(lamps, shares / shares.sum(), strict=True)):
        strength = brightness(rng, layout.frames)
        radiance = light_colour(rng) * share * flux / (np.pi * lamp.mesh.area)
        keys = np.outer(strength.keys, radiance)
        shapes.append(lamp.shape(number, Track(keys, strength.first, strength.last)))
    return shapes


def sky(rng: Rng, sun: Array | None, height: int = 64) -> Array:
    """Radiance (height, 2 * height, 3) of a sky over dark ground; latitude-longitude, y up.

    `sun` is the direction to the sun, (3,) with y up, or None under clouds. A clear day's sun gives a few times the
    light of its sky (0.3 to 30 times here).
    """
    rows = (np.arange(height) + 0.5) / height
    up = np.cos(np.pi * rows)[:, None, None]
    zenith, horizon, ground = (rng.uniform(0.3, 1.0, 3) * tone for tone in ([0.4, 0.6, 1.0], [0.9, 0.95, 1.0], 0.2))
    blend = np.clip(up, 0, 1) ** 0.5
    image = np.where(up > 0, zenith * blend + horizon * (1 - blend), ground)
    image = np.repeat(image, 2 * height, axis=1)
    if sun is not None:
        x, y, z = sun / np.linalg.norm(sun)
        row, column = np.arccos(y) / np.pi * height, np.arctan2(x, -z) / np.pi % 2 * height
        image[int(row), int(column)] += light_colour(rng) * log_uniform(rng, 300, 20000)
    return np.asarray(image)


def sun_through(rng: Rng, wall: int, size: Array) -> Array:
    """A direction (3,) from which the sun shines in through openings of a wall."""
    aside, elevation = rng.uniform(-1, 1), rng.uniform(0.2, 1.0)
    return np.asarray(wall_pose(wall, size)[:3, :3] @ [np.sin(aside), np.tan(elevation), -np.cos(aside)])
