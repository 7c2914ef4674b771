"""Dual motion vectors (NTD §3.2): where a surface that was hidden finds similar surroundings in the previous frame."""

import numpy as np
from numpy.typing import NDArray

from render.gbuffer import VisibleSurface, trace_visible
from render.stage import Stage
from scenes.camera import Array, View, motion_vectors, move, pixel_centres, unproject

SAME_SURFACE = 0.002  # of the depth: a point farther than this from the plane of what is seen there was hidden


def same_surface(
    points: Array, mesh_id: NDArray[np.integer], pixels: Array, seen: VisibleSurface, view: View
) -> NDArray[np.bool_]:
    """Whether surface points (..., 3) of `view`'s frame lie on what is `seen` there through `pixels` (..., 2).

    Background directions, whose `mesh_id` (...,) is 0, do where background is seen.
    """
    off_plane = np.abs(np.sum(seen.normal * (points - unproject(pixels, seen.depth, view)), axis=-1))
    return (seen.mesh_id == mesh_id) & ((mesh_id == 0) | (off_plane < SAME_SURFACE * seen.depth))


def dual_motion_vectors(
    stage: Stage, depth: Array, mesh_id: NDArray[np.integer], motion: Array, now: View, previous: View
) -> Array:
    """Dual motion vectors (H, W, 2) in pixels. The stage must be posed for the previous frame.

    depth, mesh_id (H, W) and motion (H, W, 2) are of the current frame. With y = x + motion the traditional position
    and z the place, now, of the surface seen at y then, the vector is y + (x - z) - x (NTD Eq. 2). It equals `motion`
    exactly where the surface itself was visible, and where y or x_prev leaves the image or lies behind a camera.
    """
    height, width = depth.shape
    x = pixel_centres(height, width)
    y = x + motion
    seen = trace_visible(stage, previous, y)
    visible = same_surface(move(unproject(x, depth, now), mesh_id, now, previous), mesh_id, y, seen, previous)

    z = y + motion_vectors(y, seen.depth, seen.mesh_id, previous, now)
    x_previous = y + (x - z)

    def inside(p: Array) -> NDArray[np.bool_]:
        return np.asarray(((p >= 0) & (p < (width, height))).all(axis=-1))

    # z behind the camera is FAR_OUTSIDE, which takes x_previous out of the image too.
    use_dual = ~visible & inside(y) & inside(x_previous)
    return np.where(use_dual[..., None], x_previous - x, motion)
