"""The Cornell box, two units wide, open towards +z, and a version in which its content moves.

Goral et al. 1984, "Modeling the interaction of light between diffuse surfaces". Reflectances and the light's colour are
the RGB values that renderers commonly ship for the measured originals.
"""

from collections.abc import Sequence

import numpy as np
import trimesh

from scenes.animation import Camera, RigidMotion, Scene, Shape, Track
from scenes.bsdf import diffuse_bsdf, rgb
from scenes.camera import Array
from scenes.draws import Rng

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
    mesh: trimesh.Trimesh = trimesh.creation.box((width, height, width))
    mesh.apply_translation((0, height / 2, 0))
    return mesh


def empty_box() -> list[Shape]:
    return [
        Shape("floor", quad((-1, -1, 1), (1, -1, 1), (1, -1, -1), (-1, -1, -1)), WHITE),
        Shape("ceiling", quad((-1, 1, -1), (1, 1, -1), (1, 1, 1), (-1, 1, 1)), WHITE),
        Shape("back", quad((-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)), WHITE),
        Shape("red-wall", quad((-1, -1, 1), (-1, -1, -1), (-1, 1, -1), (-1, 1, 1)), RED),
        Shape("green-wall", quad((1, -1, -1), (1, -1, 1), (1, 1, 1), (1, 1, -1)), GREEN),
    ]


def light(position: Track, radiance: Track) -> Shape:
    corners = [(-0.235, 0, -0.19), (0.235, 0, -0.19), (0.235, 0, 0.19), (-0.235, 0, 0.19)]
    return Shape("light", quad(*corners), WHITE, radiance, RigidMotion(position, Track.constant(0.0)))


def block(name: str, width: float, height: float, position: Track, angle: Track) -> Shape:
    return Shape(name, block_mesh(width, height), WHITE, motion=RigidMotion(position, angle))


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


def fly(keys: Keys, low: Sequence[float], high: Sequence[float]) -> Camera:
    """A smooth flight through random points of a box that looks around the middle of the Cornell box."""
    target = keys.between([-0.35, -0.55, -0.8], [0.35, 0.15, -0.4])
    return Camera(keys.between(low, high), target, Track.constant(75.0))


def cornell_box(rng: Rng, frames: int) -> Scene:
    """The classic box: two white blocks and a ceiling light; only the camera moves."""
    short = block("short-block", 0.6, 0.6, Track.constant([0.33, FLOOR_HEIGHT, 0.35]), Track.constant(-0.29))
    tall = block("tall-block", 0.6, 1.2, Track.constant([-0.33, FLOOR_HEIGHT, -0.28]), Track.constant(0.30))
    lamp = light(Track.constant([0.0, 0.99, 0.0]), Track.constant(LIGHT_RADIANCE))
    return Scene((*empty_box(), short, tall, lamp), fly(Keys(rng, frames), [-0.8, -0.4, 0.75], [0.8, 0.7, 0.98]))


def cornell_box_moving(rng: Rng, frames: int) -> Scene:
    """The blocks slide past each other and rotate, each in its own lane; the light moves slowly.

    The lanes are farther apart than the blocks' diagonals reach, so nothing ever touches. Speeds are bounded so that
    dual motion vectors, which reach one step of the occluder beside it, mostly find the disoccluded surface.
    """
    keys = Keys(rng, frames)
    sides = np.where(np.arange(keys.count) % 2 == 0, -1.0, 1.0) * rng.choice([-1.0, 1.0])

    def lane(z: float, side: Array) -> Track:
        x = side * rng.uniform(0.25, 0.55, keys.count)
        return keys.track(np.stack([x, np.full(keys.count, FLOOR_HEIGHT), np.full(keys.count, z)], axis=1))

    def turn() -> Track:
        return keys.track(rng.uniform(-np.pi, np.pi) + np.cumsum(rng.uniform(-0.3, 0.3, keys.count)))

    short = block("short-block", 0.5, 0.6, lane(0.3, sides), turn())
    tall = block("tall-block", 0.5, 1.2, lane(-0.5, -sides), turn())
    brightness = keys.track(LIGHT_RADIANCE * rng.uniform(0.7, 1.3, (keys.count, 1)))
    lamp = light(keys.between([-0.6, 0.99, -0.5], [0.6, 0.99, 0.5]), brightness)
    return Scene((*empty_box(), short, tall, lamp), fly(keys, [-0.3, 0.0, 0.85], [0.3, 0.5, 0.98]))
