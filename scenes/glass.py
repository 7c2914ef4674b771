"""Scenes of glass: a pane, vessels on a table, a solid sphere, a frosted door, coated metal and a vitrine. Metres.

Each by itself with a camera that moves, and as NAME-moving with a camera at rest and things that move.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from scenes.animation import AT_REST, Camera, RigidMotion, Scene, Shape, Track, still
from scenes.camera import Array
from scenes.colours import Bsdf, bitmap, diffuse_bsdf, rgb
from scenes.draws import Rng
from scenes.finish import CLEAR_GLASS, GLASS
from scenes.meshes import Surface, hollow, lathe, silhouette, slab, solid, superellipsoid, tube
from scenes.textures import bond, sky, texture

WATER: Bsdf = {"type": "dielectric", "int_ior": 1.33}
FROSTED: Bsdf = {"type": "roughdielectric", "int_ior": GLASS, "alpha": 0.2}
SILVER: Bsdf = {"type": "conductor", "material": "Ag"}
GLASS_DEPTH = 10  # path edges: through a vitrine and back


def painted(*colour: float) -> Bsdf:
    return diffuse_bsdf(rgb(colour))


def thing(name: str, surface: Surface, bsdf: Bsdf, motion: RigidMotion = AT_REST) -> Shape:
    return Shape(name, surface.mesh(), bsdf, motion=motion, smooth=surface.smooth)


def lamp(name: str, surface: Surface, radiance: Sequence[float]) -> Shape:
    return Shape(name, surface.mesh(), painted(0.5, 0.5, 0.5), radiance=Track.constant(radiance))


def room(rng: Rng, width: float, height: float, depth: float) -> list[Shape]:
    """Floor, ceiling and walls about the y axis, the last at the front (towards -z)."""
    wall = 0.1
    return [
        thing("floor", slab(width, wall, depth).at(0, -wall), diffuse_bsdf(bitmap(texture(rng), 0.7))),
        thing("ceiling", slab(width, wall, depth).at(0, height), painted(0.8, 0.8, 0.8)),
        thing("left", slab(wall, height, depth).at(-(width + wall) / 2), diffuse_bsdf(bitmap(texture(rng), 0.5))),
        thing("right", slab(wall, height, depth).at((width + wall) / 2), diffuse_bsdf(bitmap(texture(rng), 0.5))),
        thing("behind", slab(width, height, wall).at(z=(depth + wall) / 2), diffuse_bsdf(bitmap(texture(rng), 0.5))),
        thing("front", slab(width, height, wall).at(z=-(depth + wall) / 2), painted(0.7, 0.7, 0.65)),
    ]


class Setting(NamedTuple):
    """A scene for a camera that moves between two places, and what slides in it instead."""

    shapes: list[Shape]
    eyes: tuple[Sequence[float], Sequence[float]]
    target: Sequence[float]
    x_fov: float
    slides: Mapping[str, tuple[Sequence[float], Sequence[float], float]]  # by name: start; step, turn (rad) a frame
    sky: Array | None = None


def pane(rng: Rng) -> Setting:
    """A window at dusk: a street behind it, and the lit room reflected in it."""
    brick, joint = bond(6, 16, 0.5 * (np.arange(16) % 2))
    tone = (0.6 + 0.6 * rng.uniform(0, 1, 96)[brick])[..., None]
    shade = np.where(joint < 0.006, 1.3, 1.0)[..., None]
    facade = np.clip(np.array([0.35, 0.16, 0.1]) * tone * shade, 0.02, 0.9)
    plaster = painted(0.75, 0.72, 0.65)
    car = superellipsoid(2.6, 1.1, 1.2, 5, 3).at(0, -0.35)
    shapes = [
        thing("sill", slab(4, 0.8, 0.1), plaster),
        thing("lintel", slab(4, 0.4, 0.1).at(0, 2.2), plaster),
        *(thing(f"post {side}", slab(0.6, 1.4, 0.1).at(1.7 * side, 0.8), plaster) for side in (-1, 1)),
        thing("pane", slab(2.8, 1.4, 0.01).at(0, 0.8), CLEAR_GLASS),
        thing("road", slab(30, 0.1, 12).at(0, -0.5, -6.5), painted(0.2, 0.2, 0.22)),
        thing("kerb", slab(30, 0.15, 1.5).at(0, -0.4, -8), diffuse_bsdf(bitmap(texture(rng), 0.5))),
        thing("facade", slab(30, 8, 0.3).at(0, -0.4, -9), diffuse_bsdf(bitmap(facade.astype(np.float32), 0.4))),
        *(lamp(f"window {i}", slab(0.9, 1.2, 0.1).at(2.2 * i - 4.4, 1.3, -8.85), (0.8, 0.6, 0.3)) for i in (0, 2, 3)),
        thing("car", car, painted(0.7, 0.06, 0.04), still((0.4, 0, -5), 0)),
        # The window's wall is the room's front.
        *(replace(shape, motion=still((0, 0, 2), 0)) for shape in room(rng, 4, 2.6, 4)[:-1]),
        thing("ball", superellipsoid(0.5, 0.5, 0.5, 2, 4), painted(0.1, 0.5, 0.2), still((-0.5, 0.9, 1.0), 0)),
        lamp("lamp", slab(2.4, 0.04, 1.4).at(0.6, 2.5, 2.6), (2, 1.8, 1.5)),
    ]
    slides = {"car": ((-1.2, 0, -5), (0.12, 0, 0), 0.0), "ball": ((-0.5, 0.9, 1.0), (0.03, 0, 0.01), 0.0)}
    return Setting(shapes, ((0.4, 1.5, 2.6), (0.7, 1.55, 2.4)), (0.0, 1.35, 0), 62, slides, 0.3 * sky(rng, sun=None))


def table(rng: Rng) -> Setting:
    """A bottle and a glass of water with a straw on a patterned table."""
    radii = np.array([0.95, 1, 1, 0.95, 0.4, 0.36, 0.38]) * 0.045
    bottle = lathe(hollow(silhouette(radii, 0.3, 40), 0.003, 0.01), 64)
    tumbler = lathe(hollow(silhouette([0.032, 0.036, 0.038], 0.12, 16), 0.002, 0.008), 64)
    water = lathe(solid(silhouette([0.0297, 0.0322, 0.0342], 0.07, 16)), 64)
    can = lathe(solid(silhouette([0.04, 0.04], 0.13, 4)), 48)
    shapes = [
        *room(rng, 3, 2.4, 3),
        thing("table", slab(1.2, 0.04, 0.8).at(0, 0.7), diffuse_bsdf(bitmap(texture(rng), 2.5))),
        thing("bottle", bottle.at(-0.09, 0.741), CLEAR_GLASS),
        thing("glass", tumbler.at(0.07, 0.741, 0.05), CLEAR_GLASS),
        thing("water", water.at(0.07, 0.7495, 0.05), WATER),
        thing("straw", tube([(0.062, 0.765, 0.05), (0.095, 0.93, 0.04)], 0.003), painted(0.8, 0.1, 0.1)),
        thing("box", slab(0.12, 0.18, 0.12).at(0.02, 0.74, -0.22), painted(0.1, 0.25, 0.6)),
        thing("can", can.at(0.2, 0.74, -0.15), painted(0.75, 0.55, 0.1)),
        lamp("softbox", slab(2.2, 0.04, 2.2).at(0.2, 2.3, 0.2), (2.4, 2.4, 2.2)),
    ]
    slides = {"box": ((-0.12, 0, 0), (0.012, 0, 0), 0.02)}
    return Setting(shapes, ((0.0, 1.02, 0.62), (0.1, 1.0, 0.6)), (0.0, 0.82, 0), 45, slides)


def sphere(rng: Rng) -> Setting:
    """A solid ball of glass before blocks."""
    shapes = [
        *room(rng, 4, 2.6, 4),
        thing("ball", superellipsoid(0.7, 0.7, 0.7, 2, 5).at(0, 0.002), CLEAR_GLASS),
        thing("cube", slab(0.35, 0.35, 0.35).at(-0.45, 0, -0.8), painted(0.7, 0.1, 0.08)),
        thing("tower", slab(0.3, 0.9, 0.3).at(0.5, 0, -0.9), diffuse_bsdf(bitmap(texture(rng), 1.5))),
        thing("cone", lathe(solid([(0.2, 0), (0.01, 0.5)]), 48).at(0.05, 0, -1.1), painted(0.1, 0.3, 0.7)),
        lamp("softbox", slab(2.4, 0.04, 2.4).at(0.5, 2.5, 0.5), (2.6, 2.4, 2.2)),
    ]
    slides = {"cone": ((-0.4, 0, 0), (0.04, 0, 0), 0.0)}
    return Setting(shapes, ((0.0, 0.75, 1.7), (0.2, 0.7, 1.65)), (0, 0.38, 0), 50, slides)


def door(rng: Rng) -> Setting:
    """A door of frosted glass beside a clear pane, and a lit room behind both."""
    frame = painted(0.5, 0.5, 0.52)
    shapes = [
        *room(rng, 4, 2.5, 5),
        *(thing(f"post {i}", slab(0.08, 2.3, 0.08).at(x), frame) for i, x in enumerate((-1.0, 0.0, 1.0))),
        thing("beam", slab(4, 0.2, 0.1).at(0, 2.3), frame),
        *(thing(f"wall {side}", slab(0.96, 2.3, 0.08).at(1.52 * side), painted(0.7, 0.68, 0.6)) for side in (-1, 1)),
        thing("door", slab(0.9, 2.28, 0.012).at(-0.5, 0.01), FROSTED),
        thing("clear", slab(0.9, 2.28, 0.012).at(0.5, 0.01), CLEAR_GLASS),
        thing("chest", slab(0.5, 0.8, 0.4).at(-0.4, 0, -0.6), painted(0.65, 0.2, 0.05)),
        thing("plinth", slab(0.3, 1.1, 0.3).at(0.6, 0, -1.2), diffuse_bsdf(bitmap(texture(rng), 1.5))),
        thing("ball", superellipsoid(0.45, 0.45, 0.45, 2, 4).at(0.5, 0, -0.5), painted(0.05, 0.35, 0.6)),
        lamp("lamp behind", slab(2.4, 0.04, 1.8).at(0, 2.45, -1.3), (1.7, 1.6, 1.3)),
        lamp("lamp", slab(1.6, 0.04, 1.6).at(0.5, 2.45, 1.3), (0.7, 0.7, 0.7)),
    ]
    slides = {"ball": ((-1.0, 0, 0), (0.08, 0, 0), 0.0)}
    return Setting(shapes, ((0.2, 1.35, 1.9), (-0.05, 1.35, 1.9)), (0.0, 1.0, -0.3), 62, slides)


def coat(rng: Rng) -> Setting:
    """Metal under a clear coat."""
    outline = silhouette(np.array([0.9, 1.0, 0.85, 0.45, 0.4, 0.55]) * 0.3, 0.8, 40) + np.array([0, 0.003])
    around = np.stack([outline[0] - [0, 0.002], *outline, outline[-1] + [0, 0.004]])
    copper, aluminium = ({"type": "roughconductor", "material": name, "alpha": 0.2} for name in ("Cu", "Al"))
    shapes = [
        *room(rng, 4, 2.6, 4),
        thing("vase", lathe(solid(outline - np.array([0.004, 0])), 96), copper),
        thing("coat", lathe(solid(around), 96), CLEAR_GLASS),
        thing("plate", slab(0.6, 0.5, 0.03).at(-0.65, 0, -0.3), aluminium),
        thing("plate's coat", slab(0.612, 0.512, 0.042).at(-0.65, -0.006, -0.3), CLEAR_GLASS),
        thing("cube", slab(0.3, 0.3, 0.3).at(0.55, 0, 0.3), painted(0.7, 0.1, 0.08)),
        thing("tower", slab(0.25, 1.0, 0.25).at(0.6, 0, -0.6), diffuse_bsdf(bitmap(texture(rng), 1.5))),
        lamp("softbox", slab(2.0, 0.04, 2.0).at(0.7, 2.5, 0.7), (3, 2.8, 2.4)),
    ]
    slides = {"cube": ((-0.15, 0, 0.2), (0.025, 0, 0), 0.03)}
    return Setting(shapes, ((-0.1, 0.85, 1.6), (0.15, 0.85, 1.6)), (0, 0.4, 0), 52, slides)


def vitrine(rng: Rng) -> Setting:
    """A glass case with a mirror at its back, figures and a lamp in it."""
    figure = lathe(solid(silhouette([0.07, 0.03, 0.08, 0.05, 0.02], 0.4, 30)), 48)
    shapes = [
        *room(rng, 4, 2.6, 4),
        thing("plinth", slab(1.1, 0.8, 0.6), diffuse_bsdf(bitmap(texture(rng), 1.2))),
        thing("left pane", slab(0.02, 0.7, 0.5).at(-0.5, 0.802), CLEAR_GLASS),
        thing("right pane", slab(0.02, 0.7, 0.5).at(0.5, 0.802), CLEAR_GLASS),
        thing("front glass pane", slab(0.98, 0.7, 0.008).at(0, 0.802, 0.25), CLEAR_GLASS),
        thing("lid", slab(1.06, 0.03, 0.56).at(0, 1.504), painted(0.3, 0.2, 0.1)),
        thing("mirror", slab(0.96, 0.68, 0.01).at(0, 0.803, -0.24), SILVER),
        thing("ball", superellipsoid(0.2, 0.2, 0.2, 2, 4).at(-0.25, 0.801), painted(0.7, 0.1, 0.05)),
        thing("figure", figure.at(0.05, 0.801), painted(0.7, 0.6, 0.1)),
        thing("cube", slab(0.15, 0.15, 0.15).at(0.3, 0.801, 0.03), painted(0.1, 0.2, 0.65)),
        lamp("strip", slab(0.9, 0.02, 0.4).at(0, 1.482, 0.0), (2.2, 2, 1.7)),
        lamp("lamp", slab(2.2, 0.04, 2.2).at(-0.4, 2.5, 0.6), (0.7, 0.66, 0.6)),
    ]
    slides = {"cube": ((-0.1, 0, 0.0), (0.008, 0, 0), 0.04)}
    return Setting(shapes, ((0.25, 1.3, 1.3), (0.05, 1.3, 1.35)), (0, 1.12, 0), 50, slides)


SETTINGS: dict[str, Callable[[Rng], Setting]] = {
    f"glass-{setting.__name__}": setting for setting in (pane, table, sphere, door, coat, vitrine)
}
TEXTURE_SEED = 7  # they look alike in all clips


def glass_scene(name: str, camera_moves: bool, rng: Rng, frames: int) -> Scene:
    """The setting of that name with a moving camera, or with things that move."""
    setting = SETTINGS[name](np.random.default_rng(TEXTURE_SEED))
    last = max(frames - 1, 1)
    shapes = {shape.name: shape for shape in setting.shapes}
    slides = {} if camera_moves else setting.slides
    for moving, (start, step, turn) in slides.items():
        position = Track(np.array(start) + np.outer([0, last], step), 0, last)
        motion = RigidMotion(position, Track(np.array([0.0, turn * last]), 0, last))
        shapes[moving] = replace(shapes[moving], motion=motion)
    eyes = np.array(setting.eyes if camera_moves else setting.eyes[:1])
    camera = Camera(Track(eyes, 0, last), Track.constant(setting.target), Track.constant(setting.x_fov))
    return Scene(tuple(shapes.values()), camera, GLASS_DEPTH, setting.sky)


GLASS_SCENES = {
    name + ending: partial(glass_scene, name, not ending) for ending in ("", "-moving") for name in SETTINGS
}
