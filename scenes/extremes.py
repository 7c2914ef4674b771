"""Scenes at the limits of what numbers and denoisers bear, variations of the Cornell box."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from scenes.animation import Array, Camera, RigidMotion, Scene, Shape, Track
from scenes.cornell import box, cornell_box, cornell_box_moving
from scenes.lighting import sky

Rng = np.random.Generator
Build = Callable[[Rng, int], Scene]

TINY_LIGHT = 0.005  # of the size of the Cornell box's


def repaint(scene: Scene, paint: Callable[[Shape], dict[str, Any]]) -> Scene:
    """The scene with other materials on everything that does not shine."""
    shapes = [s if s.radiance is not None else replace(s, bsdf=paint(s)) for s in scene.shapes]
    return replace(scene, shapes=tuple(shapes))


def grey(value: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": [value] * 3}}


def sharp(rng: Rng, frames: int) -> Scene:
    """Blocks of metal so smooth (alpha 0.001) that their highlights are nearly never sampled."""
    metal = {"type": "roughconductor", "material": "Al", "alpha": 0.001}
    return repaint(cornell_box(rng, frames), lambda shape: metal if "block" in shape.name else shape.bsdf)


def tiny_light(rng: Rng, frames: int) -> Scene:
    """A light of radiance 1e5, more than float16 holds, and hardly any size."""
    scene = cornell_box_moving(rng, frames)
    light = scene.shapes[-1]
    mesh = light.mesh.copy()
    mesh.apply_scale(TINY_LIGHT)
    small = replace(light, mesh=mesh, radiance=Track.constant([1e5, 1e5, 1e5]))
    return replace(scene, shapes=(*scene.shapes[:-1], small))


def black_and_white(rng: Rng, frames: int) -> Scene:
    """Blocks that reflect nothing in a room that reflects everything."""
    return repaint(cornell_box(rng, frames), lambda shape: grey(0.0 if "block" in shape.name else 1.0))


def scaled(scene: Scene, factor: float) -> Scene:
    """The same scene in other units."""

    def grow(track: Track) -> Track:
        return replace(track, keys=track.keys * factor)

    def larger(shape: Shape) -> Shape:
        mesh = shape.mesh.copy()
        mesh.apply_scale(factor)
        return replace(shape, mesh=mesh, motion=RigidMotion(grow(shape.motion.position), shape.motion.angle))

    camera = replace(scene.camera, eye=grow(scene.camera.eye), target=grow(scene.camera.target))
    return replace(scene, shapes=tuple(map(larger, scene.shapes)), camera=camera)


def small(rng: Rng, frames: int) -> Scene:
    """The moving box in units of 1e-3."""
    return scaled(cornell_box_moving(rng, frames), 1e-3)


def large(rng: Rng, frames: int) -> Scene:
    """The moving box in units of 1e4."""
    return scaled(cornell_box_moving(rng, frames), 1e4)


def only_sky(rng: Rng, frames: int) -> Scene:
    """Nothing at all before a sky; the camera turns."""
    turn = rng.uniform(-np.pi, np.pi) + np.linspace(0, 0.02 * frames, 5)
    target: Array = np.stack([np.cos(turn), np.full(5, 0.3), np.sin(turn)], axis=1)
    return Scene(
        (),
        Camera(Track.constant([0.0, 0.0, 0.0]), Track(target, 0, max(frames - 1, 1))),
        sky=sky(rng, sun=np.array([1.0, 1.0, 1.0])),
    )


def mirrors(rng: Rng, frames: int) -> Scene:
    """The camera in a closed box of mirrors with the blocks and the light."""
    scene = cornell_box(rng, frames)
    silver = {"type": "conductor", "material": "Ag"}
    room = box(2.0, 2.0)
    room.apply_translation((0, -1, 0))
    room.invert()
    inside = [shape for shape in scene.shapes if "block" in shape.name or shape.radiance is not None]
    return replace(scene, shapes=(Shape("mirrors", room, silver), *inside), max_depth=8)


EXTREMES: dict[str, Build] = {
    "extremes-roughness": sharp,
    "extremes-light": tiny_light,
    "extremes-albedo": black_and_white,
    "extremes-small": small,
    "extremes-large": large,
    "extremes-sky": only_sky,
    "extremes-mirrors": mirrors,
}
