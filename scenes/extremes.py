"""Variations of the Cornell box at the limits of number formats and denoisers."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from scenes.animation import Camera, RigidMotion, Scene, Shape, Track
from scenes.bsdf import Bsdf, diffuse_bsdf, rgb
from scenes.cornell import block_mesh, cornell_box, cornell_box_moving
from scenes.draws import Rng
from scenes.sky import sky

SceneBuilder = Callable[[Rng, int], Scene]  # of a clip's number of frames


def repaint(scene: Scene, paint: Callable[[Shape], Bsdf]) -> Scene:
    """The scene with new materials for all shapes that emit no light."""
    painted = (shape if shape.radiance is not None else replace(shape, bsdf=paint(shape)) for shape in scene.shapes)
    return replace(scene, shapes=tuple(painted))


def sharp_highlights(rng: Rng, frames: int) -> Scene:
    """Blocks of metal (alpha 0.001) whose highlights are hardly ever sampled."""
    metal = {"type": "roughconductor", "material": "Al", "alpha": 0.001}
    return repaint(cornell_box(rng, frames), lambda shape: metal if "block" in shape.name else shape.bsdf)


def tiny_light(rng: Rng, frames: int) -> Scene:
    """A tiny light of radiance 1e5, more than float16 can represent."""
    scene = cornell_box_moving(rng, frames)
    light = scene.shapes[-1]
    mesh = light.mesh.copy()
    mesh.apply_scale(0.005)
    tiny = replace(light, mesh=mesh, radiance=Track.constant([1e5, 1e5, 1e5]))
    return replace(scene, shapes=(*scene.shapes[:-1], tiny))


def black_and_white(rng: Rng, frames: int) -> Scene:
    """Blocks that reflect nothing in a room that reflects everything."""
    black = diffuse_bsdf(rgb([0.0, 0.0, 0.0]))
    white = diffuse_bsdf(rgb([1.0, 1.0, 1.0]))
    return repaint(cornell_box(rng, frames), lambda shape: black if "block" in shape.name else white)


def rescaled(scene: Scene, factor: float) -> Scene:
    def grow(track: Track) -> Track:
        return replace(track, keys=track.keys * factor)

    def larger(shape: Shape) -> Shape:
        mesh = shape.mesh.copy()
        mesh.apply_scale(factor)
        assert isinstance(shape.motion, RigidMotion)
        return replace(shape, mesh=mesh, motion=RigidMotion(grow(shape.motion.position), shape.motion.angle))

    camera = replace(scene.camera, eye=grow(scene.camera.eye), target=grow(scene.camera.target))
    return replace(scene, shapes=tuple(map(larger, scene.shapes)), camera=camera)


def only_sky(rng: Rng, frames: int) -> Scene:
    """A sky without any shape; the camera pans."""
    turn = rng.uniform(-np.pi, np.pi) + np.linspace(0, 0.02 * frames, 5)
    target = np.stack([np.cos(turn), np.full(5, 0.3), np.sin(turn)], axis=1)
    camera = Camera(Track.constant([0.0, 0.0, 0.0]), Track(target, 0, max(frames - 1, 1)))
    return Scene((), camera, sky=sky(rng, sun=np.array([1.0, 1.0, 1.0])))


def mirrors(rng: Rng, frames: int) -> Scene:
    """A closed box of mirrors around the camera, the blocks and the light."""
    scene = cornell_box(rng, frames)
    silver = {"type": "conductor", "material": "Ag"}
    walls = block_mesh(2.0, 2.0)
    walls.apply_translation((0, -1, 0))
    walls.invert()
    inside = [shape for shape in scene.shapes if "block" in shape.name or shape.radiance is not None]
    return replace(scene, shapes=(Shape("mirrors", walls, silver), *inside), max_depth=8)


EXTREME_SCENES: dict[str, SceneBuilder] = {
    "extremes-roughness": sharp_highlights,
    "extremes-light": tiny_light,
    "extremes-albedo": black_and_white,
    "extremes-small": lambda rng, frames: rescaled(cornell_box_moving(rng, frames), 1e-3),
    "extremes-large": lambda rng, frames: rescaled(cornell_box_moving(rng, frames), 1e4),
    "extremes-sky": only_sky,
    "extremes-mirrors": mirrors,
}
