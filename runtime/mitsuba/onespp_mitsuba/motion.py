"""Motion of what a camera sees between two frames, for cameras and shapes that move and meshes that deform."""

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .camera import Array, camera_of, host, project, unproject

CORNERS = np.array([[0.0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]])


class Snapshot:
    """Camera and shapes of a scene, as they are when it is made. Without a scene, no shape moves.

    `places` are by shape: positions of vertices (V, 3), a `to_world` (4, 4), or None for what can't move. `faces` are
    the triangles (F, 3) of meshes.

    Raises ValueError for a sensor that is no pinhole camera.
    """

    def __init__(self, sensor: Any, scene: Any = None):
        self.camera = camera_of(sensor)
        self.places: list[Array | None] = []
        self.faces: list[NDArray[np.int64] | None] = []
        for shape in scene.shapes() if scene else ():
            parameters = mi.traverse(shape)
            is_mesh = "vertex_positions" in parameters
            self.faces.append(np.array(parameters["faces"], np.int64).reshape(-1, 3) if is_mesh else None)
            if is_mesh:
                self.places.append(np.array(parameters["vertex_positions"], np.float64).reshape(-1, 3))
            else:
                self.places.append(host(parameters["to_world"].matrix) if "to_world" in parameters else None)

    def moved_since(self, before: "Snapshot") -> dict[int, tuple[Array, Array]]:
        """(place now, place before) of the shapes that have moved or deformed, by index.

        Raises ValueError where shapes or vertices are others than before.
        """
        if len(self.places) != len(before.places):
            raise ValueError(f"scene: {len(self.places)} shapes, but {len(before.places)} before; reset the denoiser")
        moved = {}
        for index, (now, then) in enumerate(zip(self.places, before.places, strict=True)):
            if now is None or then is None:
                continue
            if now.shape != then.shape:
                raise ValueError(f"scene: shape {index} has another number of vertices than before; reset the denoiser")
            if not np.array_equal(now, then):
                moved[index] = now, then
        return moved


def rigid_step(now: Array, before: Array) -> Array:
    """The rigid transform (4, 4) that takes points (N, 3) from `before` to `now` best (Kabsch 1976)."""
    centre_now, centre_before = now.mean(axis=0), before.mean(axis=0)
    u, _, vt = np.linalg.svd((now - centre_now).T @ (before - centre_before))
    step = np.eye(4)
    step[:3, :3] = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    step[:3, 3] = centre_now - step[:3, :3] @ centre_before
    return step


def pose_step(now: Array, before: Array) -> Array:
    """The same of two places of a shape."""
    if now.shape[-1] == 3:
        return rigid_step(now, before)
    return rigid_step((CORNERS @ now.T)[:, :3], (CORNERS @ before.T)[:, :3])


def on_triangles(points: Array, triangles: Array) -> Array:
    """Barycentric coordinates (N, 3) of points (N, 3) in their triangles (N, 3, 3)."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    area = np.sum(normal**2, axis=-1)
    v = np.sum(np.cross(points - a, c - a) * normal, axis=-1)
    w = np.sum(np.cross(b - a, points - a) * normal, axis=-1)
    with np.errstate(all="ignore"):
        weights = np.stack([area - v - w, v, w], axis=-1) / area[:, None]
    return np.where(area[:, None] > 0, weights, 1 / 3)


def points_before(
    points: Array, shape: NDArray[np.int64], primitive: NDArray[np.int64], now: Snapshot, before: Snapshot
) -> Array:
    """Where points (H, W, 3) of surfaces were; `shape` and `primitive` (H, W) are those of the guides."""
    points = points.copy()
    for index, (place, place_before) in now.moved_since(before).items():
        here, faces = (shape == index + 1) & (primitive > 0), now.faces[index]
        if faces is None:
            step = place_before @ np.linalg.inv(place)
            points[here] = points[here] @ step[:3, :3].T + step[:3, 3]
            continue
        corners = faces[primitive[here] - 1]
        weights = on_triangles(points[here], place[corners])
        points[here] = np.einsum("nk,nki->ni", weights, place_before[corners])
    return points


def flow_between(now: Snapshot, before: Snapshot, depth: Any, shape: Any = None, primitive: Any = None) -> Array:
    """Optical flow (H, W, 2): x and y, in pixels, by which surfaces have moved in the image since the frame before.

    The guides `depth`, `shape` and `primitive` (H, W) are those of the frame now; without the latter two, nothing but
    the camera moves. Behind mirrors, shapes count as at rest. Surfaces that were behind the camera have come from
    (1e5, 1e5).

    Raises ValueError for a depth of another size than the camera's, and for shapes or vertices that were not there.
    """
    depth = np.asarray(depth, np.float64)
    if depth.shape != now.camera.size:
        raise ValueError(f"depth: expected shape {now.camera.size}, got {depth.shape}")
    points = unproject(depth, now.camera)
    if shape is not None and primitive is not None:
        ids = np.asarray(shape).astype(np.int64), np.asarray(primitive).astype(np.int64)
        points = points_before(points, *ids, now, before)
    hit = depth > 0
    return project(unproject(depth, now.camera), hit, now.camera) - project(points, hit, before.camera)
