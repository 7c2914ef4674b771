"""Axis-aligned boxes, as arrays (2, 3) of their lowest and highest x, y, z."""

import numpy as np

from scenes.camera import Array


def bounding_box(points: Array) -> Array:
    """The smallest box (2, 3) around `points` (..., 3), at least one; also around boxes (N, 2, 3)."""
    points = points.reshape(-1, 3)
    return np.stack([points.min(axis=0), points.max(axis=0)])


def transformed_box(box: Array, matrix: Array) -> Array:
    """The bounding box (2, 3) of `box` (2, 3) transformed by `matrix` (4, 4)."""
    corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
    return bounding_box(corners @ matrix[:3, :3].T + matrix[:3, 3])


def overlaps(box: Array, boxes: Array) -> bool:
    """Whether `box` (2, 3), or any of several (M, 2, 3), overlaps any of `boxes` (N, 2, 3)."""
    low, high = box[..., None, 0, :], box[..., None, 1, :]
    return bool(((low < boxes[:, 1]) & (high > boxes[:, 0])).all(axis=-1).any())


def first_hit(origin: Array, targets: Array, boxes: Array) -> Array:
    """Ray parameters (N,) from `origin` (3,), 0, to `targets` (N, 3), 1, at the first of `boxes` (M, 2, 3).

    Negative inside a box, infinite where no box is hit. The slab method of Kay and Kajiya 1986, "Ray tracing complex
    scenes".
    """
    rays = (targets - origin)[:, None, None]
    rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    near, far = np.sort((boxes[None] - origin) / rays, axis=2).transpose(2, 0, 1, 3)
    enter = near.max(axis=-1)
    leave = far.min(axis=-1)
    return np.asarray(np.where((enter < leave) & (leave > 0), enter, np.inf).min(axis=1, initial=np.inf))
