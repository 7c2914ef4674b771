"""Directions and normals of a frame whose renderer does not give them."""

import numpy as np
from numpy.typing import NDArray

from denoise.foreign_frame import Image
from scenes.camera import Array, View, look_at


def facing_pose(normal: Image | None, surface: NDArray[np.bool_]) -> Array:
    """A pose (4, 4) in the origin that looks against the mean of the visible normals, or along z without any.

    Depths are compared along this axis: no visible surface, but for grazing ones, must lie along it.
    """
    mean = normal[surface].mean(axis=0, dtype=np.float64) if normal is not None and surface.any() else np.zeros(3)
    length = np.linalg.norm(mean)
    return look_at(np.zeros(3), -mean, np.eye(3)[np.argmin(np.abs(mean / length))]) if length > 1e-3 else np.eye(4)


def depth_change(depth: Image, before: Image, motion: Image) -> float:
    """The median of the previous depth (H, W) at the end of each motion vector minus depth; 0 without surfaces."""
    height, width = depth.shape
    stride = max(1, min(height, width) // 256)
    rows, columns = np.mgrid[:height:stride, :width:stride]
    x = columns + motion[rows, columns, 0]
    y = rows + motion[rows, columns, 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    there = before[np.rint(y[inside]).astype(np.int64), np.rint(x[inside]).astype(np.int64)]
    here = depth[rows, columns][inside]
    both = (there > 0) & (here > 0)
    return float(np.median(there[both] - here[both])) if both.any() else 0.0


def facet_normals(points: Array, view: View) -> Array:
    """Normals (H, W, 3), not of unit length, of the surface through `points` (H, W, 3), toward the viewer.

    Along rows and columns the smaller step to a neighbour counts: the larger one may lead across an edge.
    """
    normal: Array = np.cross(smaller_step(points, 1), smaller_step(points, 0))
    toward = ((view.camera_to_world[:3, 3] - points) * normal).sum(axis=-1, keepdims=True)
    return np.where(toward < 0, -normal, normal)


def smaller_step(points: Array, axis: int) -> Array:
    """Differences (H, W, 3) to the nearer neighbour along an axis, 0 in images of one pixel."""
    if points.shape[axis] < 2:
        return np.zeros_like(points)
    steps = np.diff(points, axis=axis)
    ahead = np.concatenate([steps, np.take(steps, [-1], axis)], axis=axis)
    behind = np.concatenate([np.take(steps, [0], axis), steps], axis=axis)
    nearer = np.linalg.norm(ahead, axis=-1, keepdims=True) < np.linalg.norm(behind, axis=-1, keepdims=True)
    return np.where(nearer, ahead, behind)
