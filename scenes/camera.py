"""The pinhole camera: projection, its inverse and motion of surfaces between frames. Numpy only, in float64.

Camera frame (Mitsuba's): x left, y up, z forward. Pixel positions are (x right, y down), the centre of column c, row r
at (c + 0.5, r + 0.5). With C = inverse(camera_to_world): pixel = (K C p)_xy / depth, depth = (K C p)_z.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAR_OUTSIDE = 1e5  # px, outside any image yet finite: what is behind the camera projects there, in x and in y


class View(NamedTuple):
    """Camera and object poses of one frame."""

    K: Array  # (3, 3)
    camera_to_world: Array  # (4, 4)
    object_to_world: Array  # (M, 4, 4), rigid, from the rest pose of the mesh with id index + 1


def intrinsics(x_fov: float, height: int, width: int) -> Array:
    """K (3, 3) of a camera with square pixels whose horizontal field of view is `x_fov` degrees."""
    focal = 0.5 * width / np.tan(np.radians(x_fov) / 2)
    return np.array([[-focal, 0, width / 2], [0, -focal, height / 2], [0, 0, 1.0]])


STILL = np.eye(4)[None]  # object_to_world of a mesh that does not move


def view_of(projection: Array) -> View | None:
    """The view of a projection (3, 4) from world to homogeneous pixels, of positive weight before the camera.

    None where it is singular. World coordinates may be left-handed, and so is the camera's frame then.
    """
    if not np.isfinite(projection).all() or np.linalg.cond(projection[:, :3]) > 1e12:
        return None
    # RQ decomposition by a QR of the reversed matrix.
    q, r = np.linalg.qr(projection[::-1, :3].T)
    K = r.T[::-1, ::-1]
    rotation = q.T[::-1]
    signs = np.sign(np.diag(K)) * [-1, -1, 1]  # x left, y up, z forward; see above
    K = K * signs / (K[2, 2] * signs[2])
    K[0, 1] = 0  # no camera here shears
    camera_to_world = np.eye(4)
    camera_to_world[:3, :3] = (signs[:, None] * rotation).T
    camera_to_world[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    return View(K, camera_to_world, STILL)


Y_UP = np.array([0.0, 1.0, 0.0])


def cross(a: Array, b: Array) -> Array:
    """a x b (..., 3), bit for bit as by `np.cross`, which is slow for single vectors."""
    (ax, ay, az), (bx, by, bz) = ((v[..., 0], v[..., 1], v[..., 2]) for v in (a, b))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def unit(vectors: Array) -> Array:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def look_at(eye: Array, target: Array, up: Array = Y_UP) -> Array:
    """camera_to_world (..., 4, 4) of cameras at `eye` with `target` in their centres and `up` upwards, all (..., 3)."""
    forward = unit(target - eye)
    left = unit(cross(up, forward))
    axes = np.broadcast_arrays(left, cross(forward, left), forward, eye)
    matrix = np.zeros((*forward.shape[:-1], 4, 4))
    matrix[..., :3, :] = np.stack(axes, axis=-1)
    matrix[..., 3, 3] = 1
    return matrix


def up_of(axes: Array, wanted: Array) -> Array:
    """The `wanted` up (3,), or the image's own if the camera with these `axes` (3, 3) is rolled against it."""
    return wanted if abs(wanted @ axes[:, 0]) < 1e-3 * (wanted @ axes[:, 1]) else axes[:, 1]


def axis_rotation(axis: int, angle: float) -> Array:
    """The rotation (3, 3) by `angle` radians about the x, y or z axis (`axis` 0, 1, 2)."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[i, j], [i, j]] = np.cos(angle)
    matrix[i, j] = -np.sin(angle)
    matrix[j, i] = np.sin(angle)
    return matrix


def inverse_pose(matrix: Array) -> Array:
    """Inverses (..., 4, 4) of poses: rigid transforms (..., 4, 4)."""
    inverse = np.zeros_like(matrix)
    inverse[..., :3, :3] = np.swapaxes(matrix[..., :3, :3], -1, -2)
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ matrix[..., :3, 3:]
    inverse[..., 3, 3] = 1
    return inverse


def pixel_centres(height: int, width: int) -> Array:
    """Positions (H, W, 2) of all pixel centres, in pixels."""
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1)


def directions(pixels: Array, view: View) -> Array:
    """World directions (..., 3) through `pixels` (..., 2), of length 1 along the viewing axis."""
    x = (pixels[..., 0] - view.K[0, 2]) / view.K[0, 0]
    y = (pixels[..., 1] - view.K[1, 2]) / view.K[1, 1]
    return np.stack([x, y, np.ones_like(x)], axis=-1) @ view.camera_to_world[:3, :3].T


def unproject(pixels: Array, depth: Array, view: View) -> Array:
    """Points (..., 3) visible at `pixels` (..., 2) at `depth` (...,) along the viewing axis.

    Where the depth is 0 (background) they are directions: homogeneous points at infinity.
    """
    hit = (depth > 0)[..., None]
    ray = directions(pixels, view)
    return np.where(hit, view.camera_to_world[:3, 3] + depth[..., None] * ray, ray)


def project(points: Array, hit: NDArray[np.bool_], view: View) -> Array:
    """Pixel positions (..., 2) of `points` (..., 3), which are directions where `hit` (...,) is false."""
    relative = points - np.where(hit[..., None], view.camera_to_world[:3, 3], 0)
    in_camera = relative @ view.camera_to_world[:3, :3]
    depth = in_camera[..., 2]
    ahead = depth > 1e-9 * np.linalg.norm(in_camera, axis=-1)
    pixel = (in_camera @ view.K.T)[..., :2] / np.where(ahead, depth, 1)[..., None]
    # A point nearly in the plane of the eye projects to a huge but finite position: the same bound holds for it.
    return np.where(ahead[..., None], np.clip(pixel, -FAR_OUTSIDE, FAR_OUTSIDE), FAR_OUTSIDE)


def move(points: Array, mesh_id: NDArray[np.integer], source: View, target: View) -> Array:
    """Surface points (..., 3) of frame `source` moved with their meshes to `target`; background directions stay."""
    relative = target.object_to_world @ inverse_pose(source.object_to_world)
    relative = np.concatenate([np.eye(4)[None], relative])
    # M times its inverse is not exactly the identity: a mesh at rest must not pick up rounding errors.
    same = (target.object_to_world == source.object_to_world).all(axis=(1, 2))
    relative[1:][same] = np.eye(4)
    if same.all():
        return points
    matrix = relative[mesh_id]
    return np.einsum("...ij,...j->...i", matrix[..., :3, :3], points) + matrix[..., :3, 3]


def motion_vectors(pixels: Array, depth: Array, mesh_id: NDArray[np.integer], now: View, other: View) -> Array:
    """Vectors, in pixels, from `pixels` (..., 2) of the frame `now` to the same surface points in the frame `other`.

    With the previous frame as `other` this is the channel `motion`. Background (depth 0) moves with its direction.
    """
    if all(np.array_equal(a, b) for a, b in zip(now, other, strict=True)):
        return np.zeros_like(pixels)
    return project(move(unproject(pixels, depth, now), mesh_id, now, other), depth > 0, other) - pixels
