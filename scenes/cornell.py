"""The Cornell box, two units wide, open towards +z: at rest, moving, and at the limits of formats and denoisers.

Goral et al. 1984, "Modeling the interaction of light between diffuse surfaces". Reflectances and the light's colour are
the RGB values that renderers commonly ship for the measured originals.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import trimesh

from scenes.animation import Camera, RigidMotion, Scene, Shape, Track, still
from scenes.camera import Array
from scenes.colours import Bsdf, diffuse_bsdf, rgb
from scenes.draws import Rng
from scenes.textures import sky

SceneBuilder = Callable[[Rng, int], Scene]  # of a clip's number of frames

WHITE = diffuse_bsdf(rgb((0.885, 0.699, 0.666)))
RED = diffuse_bsdf(rgb((0.570, 0.043, 0.044)))
GREEN = diffuse_bsdf(rgb((0.105, 0.378, 0.076)))
LIGHT_RADIANCE = np.array([18.4, 14.0, 6.8])
FLOOR_HEIGHT = -1.0
FRAMES_BETWEEN_KEYS = 48


def quad(*corners: tuple[float, float, float]) -> trimesh.Trimesh:
    """Two triangles that face the side from which the corners run counter-clockwise."""
    return trimesh.Trimesh(vertices=np.array(corners), faces=[[0, 1, 2], [0, 2, 3]], process=False)


def block_mesh(width: float, height: float) -> trimesh.Trimesh:
    return trimesh.creation.box((width, height, width)).apply_translation((0, height / 2, 0))


class Keys:
    """Tracks through random keys at equal intervals, the same in clips of any length; a clip lies in their middle."""

    def __init__(self, rng: Rng, frames: int):
        self.rng = rng
        spans = max(1, -(-(frames - 1) // FRAMES_BETWEEN_KEYS))
        self.count = spans + 1
        self.first = -(spans * FRAMES_BETWEEN_KEYS - (frames - 1)) / 2
        self.last = self.first + spans * FRAMES_BETWEEN_KEYS

    def track(self, keys: Array) -> Track:
        return Track(keys, self.first, self.last)

    def between(self, low: Sequence[float], high: Sequence[float]) -> Track:
        """Through random points of a box."""
        return self.track(self.rng.uniform(low, high, (self.count, len(low))))

    def flight(self, low: Sequence[float], high: Sequence[float]) -> Camera:
        """Through random points of a box, looking around the middle of the Cornell box."""
        target = self.between([-0.35, -0.55, -0.8], [0.35, 0.15, -0.4])
        return Camera(self.between(low, high), target, Track.constant(75.0))


def filled_box(
    width: float, short: RigidMotion, tall: RigidMotion, light: RigidMotion, radiance: Track, camera: Camera
) -> Scene:
    """The box with two blocks of that `width` and a light, in these places."""
    lamp = quad((-0.235, 0, -0.19), (0.235, 0, -0.19), (0.235, 0, 0.19), (-0.235, 0, 0.19))
    shapes = (
        Shape("floor", quad((-1, -1, 1), (1, -1, 1), (1, -1, -1), (-1, -1, -1)), WHITE),
        Shape("ceiling", quad((-1, 1, -1), (1, 1, -1), (1, 1, 1), (-1, 1, 1)), WHITE),
        Shape("back", quad((-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)), WHITE),
        Shape("red-wall", quad((-1, -1, 1), (-1, -1, -1), (-1, 1, -1), (-1, 1, 1)), RED),
        Shape("green-wall", quad((1, -1, -1), (1, -1, 1), (1, 1, 1), (1, 1, -1)), GREEN),
        Shape("short-block", block_mesh(width, 0.6), WHITE, motion=short),
        Shape("tall-block", block_mesh(width, 1.2), WHITE, motion=tall),
        Shape("light", lamp, WHITE, radiance, light),
    )
    return Scene(shapes, camera)


def cornell_box(rng: Rng, frames: int) -> Scene:
    """The classic box: two white blocks and a ceiling light; only the camera moves."""
    short = still([0.33, FLOOR_HEIGHT, 0.35], -0.29)
    tall = still([-0.33, FLOOR_HEIGHT, -0.28], 0.30)
    camera = Keys(rng, frames).flight([-0.8, -0.4, 0.75], [0.8, 0.7, 0.98])
    return filled_box(0.6, short, tall, still([0.0, 0.99, 0.0], 0.0), Track.constant(LIGHT_RADIANCE), camera)


def cornell_box_moving(rng: Rng, frames: int) -> Scene:
    """The blocks slide past each other and rotate, each in its own lane; the light moves slowly.

    The lanes are farther apart than the blocks' diagonals reach, so nothing ever touches. Speeds are bounded so that
    dual motion vectors, which reach one step of the occluder beside it, mostly find the disoccluded surface.
    """
    keys = Keys(rng, frames)
    sides = np.where(np.arange(keys.count) % 2 == 0, -1.0, 1.0) * rng.choice([-1.0, 1.0])

    def lane(z: float, side: Array) -> RigidMotion:
        x = side * rng.uniform(0.25, 0.55, keys.count)
        place = keys.track(np.stack([x, np.full(keys.count, FLOOR_HEIGHT), np.full(keys.count, z)], axis=1))
        turn = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.uniform(-0.3, 0.3, keys.count))
        return RigidMotion(place, keys.track(turn))

    short, tall = lane(0.3, sides), lane(-0.5, -sides)
    radiance = keys.track(LIGHT_RADIANCE * rng.uniform(0.7, 1.3, (keys.count, 1)))
    light = RigidMotion(keys.between([-0.6, 0.99, -0.5], [0.6, 0.99, 0.5]), Track.constant(0.0))
    return filled_box(0.5, short, tall, light, radiance, keys.flight([-0.3, 0.0, 0.85], [0.3, 0.5, 0.98]))


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
    tiny = replace(light, mesh=light.mesh.copy().apply_scale(0.005), radiance=Track.constant([1e5, 1e5, 1e5]))
    return replace(scene, shapes=(*scene.shapes[:-1], tiny))


def black_and_white(rng: Rng, frames: int) -> Scene:
    """Blocks that reflect nothing in a room that reflects everything."""
    black, white = (diffuse_bsdf(rgb([grey] * 3)) for grey in (0.0, 1.0))
    return repaint(cornell_box(rng, frames), lambda shape: black if "block" in shape.name else white)


def rescaled(scene: Scene, factor: float) -> Scene:
    def grow(track: Track) -> Track:
        return replace(track, keys=track.keys * factor)

    def larger(shape: Shape) -> Shape:
        assert isinstance(shape.motion, RigidMotion)
        motion = RigidMotion(grow(shape.motion.position), shape.motion.angle)
        return replace(shape, mesh=shape.mesh.copy().apply_scale(factor), motion=motion)

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
    walls = trimesh.creation.box((2, 2, 2))
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
