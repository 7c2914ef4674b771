"""Animated scenes as data: shapes, lights and a camera, and their state in any frame."""

from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from scenes.camera import Y_UP, Array, View, axis_rotation, intrinsics, look_at
from scenes.colours import Bsdf


@dataclass(frozen=True)
class Track:
    """A value over time: a Catmull-Rom spline through `keys` (N, D) or (N,), evenly spaced over frames `first`..`last`.

    Catmull and Rom 1974, "A class of local interpolating splines". The first derivative is continuous between the ends;
    before `first` and after `last` the end values are held. A single key is a constant.
    """

    keys: Array
    first: float = 0.0
    last: float = 1.0

    @staticmethod
    def constant(value: ArrayLike) -> "Track":
        """A constant `value`, a scalar or (D,)."""
        return Track(np.asarray(value, dtype=np.float64)[None])

    def at(self, frame: float) -> Array:
        """The value, (D,) or a scalar, in a `frame`, which may be fractional."""
        keys = self.keys
        if len(keys) == 1:
            return keys[0]
        position = np.clip((frame - self.first) / (self.last - self.first), 0, 1) * (len(keys) - 1)
        k = min(int(position), len(keys) - 2)
        u = position - k
        # The ends are extrapolated linearly, so that the path starts and stops at constant speed.
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


@dataclass(frozen=True)
class KeyframedTrack(Track):
    """A Track with `keys` at the increasing frames `times` (N,), interpolated by a spline or by straight lines."""

    times: Array = field(default_factory=lambda: np.zeros(1))
    straight: bool = False

    def at(self, frame: float) -> Array:
        keys, times = self.keys, self.times
        if len(keys) == 1 or frame <= times[0]:
            return keys[0]
        if frame >= times[-1]:
            return keys[-1]
        k = int(np.searchsorted(times, frame, side="right")) - 1
        width = times[k + 1] - times[k]
        u = (frame - times[k]) / width
        slope = (keys[k + 1] - keys[k]) / width
        if self.straight:
            return keys[k] + width * slope * u
        leaves = (keys[k + 1] - keys[k - 1]) / (times[k + 1] - times[k - 1]) if k > 0 else slope
        arrives = (keys[k + 2] - keys[k]) / (times[k + 2] - times[k]) if k + 2 < len(keys) else slope
        return (
            keys[k]
            + width * leaves * u
            + width * (3 * slope - 2 * leaves - arrives) * u**2
            + width * (leaves + arrives - 2 * slope) * u**3
        )


@dataclass(frozen=True)
class RigidMotion:
    """A rotation by `angle` radians about the vertical axis through the shape's origin, then a translation."""

    position: Track  # (3,) world units
    angle: Track  # scalar, radians

    def matrix(self, frame: float) -> Array:
        """object_to_world (4, 4), rigid."""
        matrix = np.eye(4)
        matrix[:3, :3] = axis_rotation(1, float(self.angle.at(frame)))
        matrix[:3, 3] = self.position.at(frame)
        return matrix

    def varies(self) -> bool:
        return self.position.varies() or self.angle.varies()


@dataclass(frozen=True)
class FreeMotion:
    """Rotations about the x, then the y, then the z axis through `pivot`, and then a translation."""

    pivot: Array  # (3,) world units
    position: Track  # (3,) world units
    rotation: Track  # (3,) radians

    def matrix(self, frame: float) -> Array:
        turn = np.eye(3)
        for axis, angle in enumerate(self.rotation.at(frame)):
            turn = axis_rotation(axis, angle) @ turn
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        matrix[:3, 3] = self.pivot + self.position.at(frame) - turn @ self.pivot
        return matrix

    def varies(self) -> bool:
        return self.position.varies() or self.rotation.varies()


def still(place: ArrayLike, angle: float) -> RigidMotion:
    """At rest at `place` (3,), rotated by `angle` radians about the vertical axis."""
    return RigidMotion(Track.constant(place), Track.constant(angle))


AT_REST = still([0.0, 0.0, 0.0], 0.0)


@dataclass(frozen=True)
class Shape:
    """A mesh in its rest pose with one material, which may emit light and may move."""

    name: str
    mesh: trimesh.Trimesh  # with texture coordinates in visual.uv where the material has a texture
    bsdf: Bsdf
    radiance: Track | None = None  # emitted radiance (3,), linear RGB; None does not emit
    motion: RigidMotion | FreeMotion = AT_REST
    smooth: bool = False  # shade with the mesh's vertex normals instead of its faces'


UNCHANGED = Track.constant(1.0)


@dataclass(frozen=True)
class StockShape:
    """A shape as a scene file describes it: dictionaries of any Mitsuba plugins.

    Dictionaries that are the same object are loaded once. Bitmaps and meshes may be file names.
    """

    name: str
    geometry: dict[str, Any]
    bsdf: dict[str, Any] | None  # None where shapes within the geometry (of an instance) have their own
    emitter: dict[str, Any] | None = None
    gain: Track = UNCHANGED  # scalar, multiplies the light that it emits
    motion: RigidMotion | FreeMotion = AT_REST  # relative to its pose in the file


@dataclass(frozen=True)
class StockLight:
    """A light without a shape, such as a point or a sky, as Mitsuba's dictionary."""

    name: str
    emitter: dict[str, Any]
    gain: Track = UNCHANGED  # scalar


@dataclass(frozen=True)
class Camera:
    eye: Track  # (3,) world units
    target: Track  # (3,) world units
    x_fov: Track = field(default_factory=lambda: Track.constant(60.0))  # horizontal field of view, degrees
    up: Track = field(default_factory=lambda: Track.constant([0.0, 1.0, 0.0]))  # (3,), any length

    @staticmethod
    def at_rest(eye: ArrayLike, target: ArrayLike, x_fov: float, up: ArrayLike = Y_UP) -> "Camera":
        return Camera(*map(Track.constant, (eye, target, x_fov, up)))


def frozen(value: Any) -> Any:
    """A Track as in frame 0 for ever; dataclasses, such as a Scene, and tuples with all Tracks in them frozen."""
    if isinstance(value, Track):
        return Track.constant(value.at(0))
    if isinstance(value, tuple):
        return tuple(map(frozen, value))
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{each.name: frozen(getattr(value, each.name)) for each in fields(value)})
    return value


@dataclass(frozen=True)
class Scene:
    """An animated scene. A mesh id is the index in `meshes` plus one; 0 is the background."""

    shapes: tuple[Shape, ...]
    camera: Camera
    max_depth: int = 3  # path edges from the camera to a light: 3 is one indirect bounce
    sky: Array | None = None  # radiance (H, W, 3) from all directions, latitude-longitude, y up; None is black
    stock: tuple[StockShape, ...] = ()
    lights: tuple[StockLight, ...] = ()

    @property
    def meshes(self) -> tuple[Shape | StockShape, ...]:
        """All that have a mesh id, in its order."""
        return (*self.shapes, *self.stock)

    def view(self, frame: float, height: int, width: int) -> View:
        """Camera and object poses of a `frame`, for an image of `height` x `width` pixels."""
        return View(
            K=intrinsics(float(self.camera.x_fov.at(frame)), height, width),
            camera_to_world=look_at(self.camera.eye.at(frame), self.camera.target.at(frame), self.camera.up.at(frame)),
            object_to_world=np.array([shape.motion.matrix(frame) for shape in self.meshes]).reshape(-1, 4, 4),
        )

    def moves(self) -> bool:
        return any(shape.motion.varies() for shape in self.meshes)
