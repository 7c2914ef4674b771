"""Animated scenes as data: shapes, lights and a camera that move and change, and what they are in any frame."""

from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from scenes.bsdf import Bsdf
from scenes.camera import Array, View, intrinsics, look_at


@dataclass(frozen=True)
class Track:
    """A value over time: a spline through `keys` (N, D) or (N,), which are spread evenly over frames `first`..`last`.

    It is that of Catmull and Rom 1974, "A class of local interpolating splines": its first derivative is continuous
    between the ends. Before `first` and after `last` the ends are held. One key is a constant.
    """

    keys: Array
    first: float = 0.0
    last: float = 1.0

    @staticmethod
    def constant(value: ArrayLike) -> "Track":
        """The same `value`, a scalar or (D,), for ever."""
        return Track(np.asarray(value, dtype=np.float64)[None])

    def at(self, frame: float) -> Array:
        """The value, (D,) or a scalar, in a `frame`, which may lie between whole ones."""
        keys = self.keys
        if len(keys) == 1:
            return keys[0]
        position = np.clip((frame - self.first) / (self.last - self.first), 0, 1) * (len(keys) - 1)
        k = min(int(position), len(keys) - 2)
        u = position - k
        # Ends are extended linearly, so that the path leaves and arrives at constant speed.
        before = keys[k - 1] if k > 0 else 2 * keys[0] - keys[1]
        after = keys[k + 2] if k + 2 < len(keys) else 2 * keys[-1] - keys[-2]
        a = keys[k]
        b = keys[k + 1]
        return 0.5 * (
            2 * a
            + (b - before) * u
            + (2 * before - 5 * a + 4 * b - after) * u**2
            + (3 * a - 3 * b + after - before) * u**3
        )

    def varies(self) -> bool:
        """Whether the value ever changes."""
        return bool((self.keys != self.keys[0]).any())

    def held(self) -> "Track":
        """The value of frame 0, for ever."""
        return Track.constant(self.at(0))


@dataclass(frozen=True)
class RigidMotion:
    """A turn by `angle` radians about the vertical axis through the shape's rest origin, then a shift."""

    position: Track  # (3,) world units
    angle: Track  # scalar, radians

    def matrix(self, frame: float) -> Array:
        """object_to_world (4, 4), rigid."""
        cos = np.cos(self.angle.at(frame))
        sin = np.sin(self.angle.at(frame))
        matrix = np.array([[cos, 0, sin, 0], [0, 1, 0, 0], [-sin, 0, cos, 0], [0, 0, 0, 1.0]])
        matrix[:3, 3] = self.position.at(frame)
        return matrix

    def varies(self) -> bool:
        """Whether it ever moves or turns anything."""
        return self.position.varies() or self.angle.varies()


def still(place: ArrayLike, angle: float) -> RigidMotion:
    """At rest at `place` (3,), turned by `angle` radians about the vertical axis."""
    return RigidMotion(Track.constant(place), Track.constant(angle))


STILL = still([0.0, 0.0, 0.0], 0.0)


@dataclass(frozen=True)
class Shape:
    """A mesh in its rest pose with one material, which may emit light and may move."""

    name: str
    mesh: trimesh.Trimesh  # with texture coordinates in visual.uv where the material has a texture
    bsdf: Bsdf
    radiance: Track | None = None  # emitted radiance (3,), linear RGB; None does not emit
    motion: RigidMotion = STILL
    smooth: bool = False  # shade with the mesh's vertex normals instead of its faces'


@dataclass(frozen=True)
class Camera:
    """Where the camera is, what it looks at and how wide its view is, over time."""

    eye: Track  # (3,) world units
    target: Track  # (3,) world units
    x_fov: Track = field(default_factory=lambda: Track.constant(60.0))  # horizontal field of view, degrees


@dataclass(frozen=True)
class Scene:
    """All that a renderer needs in any frame. A mesh's id is its index in `shapes` plus one; 0 is the background."""

    shapes: tuple[Shape, ...]
    camera: Camera
    max_depth: int = 3  # path edges from the camera to a light: 3 is one indirect bounce
    sky: Array | None = None  # radiance (H, W, 3) from all directions, latitude-longitude, y up; None is black

    def view(self, frame: float, height: int, width: int) -> View:
        """The projection and the objects' poses in a `frame`, for an image of `height` x `width` pixels."""
        return View(
            K=intrinsics(float(self.camera.x_fov.at(frame)), height, width),
            camera_to_world=look_at(self.camera.eye.at(frame), self.camera.target.at(frame)),
            object_to_world=np.array([shape.motion.matrix(frame) for shape in self.shapes]).reshape(-1, 4, 4),
        )

    def still(self) -> "Scene":
        """The scene of frame 0 for ever: nothing moves or changes, the camera included."""
        shapes = [
            replace(
                shape,
                radiance=shape.radiance and shape.radiance.held(),
                motion=RigidMotion(shape.motion.position.held(), shape.motion.angle.held()),
            )
            for shape in self.shapes
        ]
        camera = Camera(self.camera.eye.held(), self.camera.target.held(), self.camera.x_fov.held())
        return replace(self, shapes=tuple(shapes), camera=camera)

    def moves(self) -> bool:
        """Whether any object moves (the camera may move in any scene)."""
        return any(shape.motion.varies() for shape in self.shapes)
