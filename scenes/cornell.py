"""The Cornell box (Goral et al. 1984), two units wide, open towards +z, and a version in which its content moves.

The reflectances and the light's colour are the RGB values that renderers commonly ship for the measured originals.
"""

from typing import Any

import numpy as np
import trimesh

from scenes.animation import Array, Camera, RigidMotion, Scene, Shape, Track

WHITE, RED, GREEN = (0.885, 0.699, 0.666), (0.570, 0.043, 0.044), (0.105, 0.378, 0.076)
LIGHT = np.array([18.4, 14.0, 6.8])
FLOOR = -1.0


def diffuse(rgb: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}


def quad(*corners: tuple[float, float, float]) -> trimesh.Trimesh:
    """Two triangles; seen from where the corners run counter-clockwise, the normal points to the viewer."""
    return trimesh.Trimesh(vertices=np.array(corners), faces=[[0, 1, 2], [0, 2, 3]], process=False)


def box(width: float, height: float) -> trimesh.Trimesh:
    """A square block standing on the origin, so that its rest pose turns about its own vertical axis."""
    mesh = trimesh.creation.box((width, height, width))
    mesh.apply_translation((0, height / 2, 0))
    return mesh


def room() -> list[Shape]:
    return [
        Shape("floor", quad((-1, -1, 1), (1, -1, 1), (1, -1, -1), (-1, -1, -1)), diffuse(WHITE)),
        Shape("ceiling", quad((-1, 1, -1), (1, 1, -1), (1, 1, 1), (-1, 1, 1)), diffuse(WHITE)),
        Shape("back", quad((-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1)), diffuse(WHITE)),
        Shape("red-wall", quad((-1, -1, 1), (-1, -1, -1), (-1, 1, -1), (-1, 1, 1)), diffuse(RED)),
        Shape("green-wall", quad((1, -1, -1), (1, -1, 1), (1, 1, 1), (1, 1, -1)), diffuse(GREEN)),
    ]


def light(position: Track, radiance: Track) -> Shape:
    corners = [(-0.235, 0, -0.19), (0.235, 0, -0.19), (0.235, 0, 0.19), (-0.235, 0, 0.19)]
    motion = RigidMotion(position, Track.constant(0.0))
    return Shape("light", quad(*corners), diffuse(WHITE), radiance=radiance, motion=motion)


def block(name: str, width: float, height: float, position: Array, angle: Array, last: float) -> Shape:
    """A white block that passes through the floor positions (N, 2) = (x, z) and turns through the angles (N,)."""
    floor = np.full(len(position), FLOOR)
    path = np.stack([position[:, 0], floor, position[:, 1]], axis=1)
    return Shape(name, box(width, height), diffuse(WHITE), motion=RigidMotion(Track(path, last), Track(angle, last)))


def fly(rng: np.random.Generator, low: Array, high: Array, keys: int, last: float, x_fov: float) -> Camera:
    """A smooth flight through random points of the box low..high that looks around the middle of the room."""
    eye = rng.uniform(low, high, (keys, 3))
    target = rng.uniform([-0.35, -0.55, -0.8], [0.35, 0.15, -0.4], (keys, 3))
    return Camera(Track(eye, last), Track(target, last), Track.constant(x_fov))


def keys_for(frames: int) -> tuple[int, float]:
    """Number of spline keys and the last frame: about 12 frames between keys keep speeds alike in clips of any length."""
    return max(2, round(frames / 12) + 1), float(max(frames - 1, 1))


def cornell_box(rng: np.random.Generator, frames: int) -> Scene:
    """The classic box: two white blocks, a ceiling light, nothing moves but the camera, which flies around in it."""
    keys, last = keys_for(frames)
    short = block("short-block", 0.6, 0.6, np.array([[0.33, 0.35]]), np.array([-0.29]), last)
    tall = block("tall-block", 0.6, 1.2, np.array([[-0.33, -0.28]]), np.array([0.30]), last)
    lamp = light(Track.constant([0.0, 0.99, 0.0]), Track.constant(LIGHT))
    camera = fly(rng, np.array([-0.8, -0.4, 0.75]), np.array([0.8, 0.7, 0.98]), keys, last, x_fov=75.0)
    return Scene((*room(), short, tall, lamp), camera)


def cornell_box_moving(rng: np.random.Generator, frames: int) -> Scene:
    """The blocks slide past each other and past the back wall and turn, each in its own lane; the light moves slowly.

    The lanes are farther apart than the blocks' diagonals reach, so nothing ever touches.
    """
    keys, last = keys_for(frames)
    sides = np.where(np.arange(keys) % 2 == 0, -1.0, 1.0) * rng.choice([-1.0, 1.0])

    def lane(z: float, side: Array) -> Array:
        x = side * rng.uniform(0.25, 0.55, keys)
        return np.stack([x, np.full(keys, z)], axis=1)

    def turns() -> Array:
        return rng.uniform(-np.pi, np.pi) + np.cumsum(rng.uniform(-0.8, 0.8, keys))

    short = block("short-block", 0.5, 0.6, lane(0.3, sides), turns(), last)
    tall = block("tall-block", 0.5, 1.2, lane(-0.5, -sides), turns(), last)
    slide = np.stack([rng.uniform(-0.6, 0.6, 2), np.full(2, 0.99), rng.uniform(-0.5, 0.5, 2)], axis=1)
    lamp = light(Track(slide, last), Track(LIGHT * rng.uniform(0.7, 1.3, (2, 1)), last))
    camera = fly(rng, np.array([-0.6, -0.3, 0.8]), np.array([0.6, 0.6, 0.98]), keys, last, x_fov=75.0)
    return Scene((*room(), short, tall, lamp), camera)
