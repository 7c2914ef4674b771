"""The pinhole camera of a sensor: the runtime's conventions, in numpy.

Camera space is Mitsuba's: x left, y up, z forward. Pixel positions are (x right, y down), with the centre of the first
pixel at (0.5, 0.5): pixel = (K p) / p_z.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FAR_OUTSIDE = 1e5  # px, where points behind the camera project to
PROBES = np.array([[0.0, 0.0], [1.0, 1.0], [0.5, 0.25]])  # positions in the image, of which the last one is a test


class Camera(NamedTuple):
    size: tuple[int, int]  # (H, W)
    K: Array  # (3, 3)
    camera_to_world: Array  # (4, 4), rigid


def host(value: Any) -> Array:
    """A matrix or vector of any variant as float64, without the axis of lanes."""
    array = np.array(value, np.float64)
    return array[..., 0] if array.ndim in (2, 3) and array.shape[-1] == 1 else array


def camera_of(sensor: Any) -> Camera:
    """Raises ValueError for a sensor whose rays do not all pass through one point, as those of a thin lens do not."""
    kind = sensor.class_name()
    if sensor.needs_aperture_sample():
        raise ValueError(f"sensor: depth of field blurs what guides show sharply: use a perspective sensor, not {kind}")
    width, height = (int(n) for n in sensor.film().crop_size())
    pose = host(sensor.world_transform().matrix)
    rays = [sensor.sample_ray(0, 0.5, list(map(float, probe)), [0.5, 0.5])[0] for probe in PROBES]
    directions = np.stack([host(ray.d) for ray in rays]) @ np.linalg.inv(pose)[:3, :3].T
    with np.errstate(all="ignore"):
        slopes = directions[:, :2] / directions[:, 2:]
        focal = (width, height) / (slopes[1] - slopes[0])
        centre = -slopes[0] * focal
        error = slopes[2] * focal + centre - PROBES[2] * (width, height)
    if not (directions[:, 2] > 0).all() or not (np.abs(error) < 0.01).all():
        raise ValueError(f"sensor: expected a pinhole camera, such as perspective; got {kind}")
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1]])
    return Camera((height, width), K, pose)


def unproject(depth: Array, camera: Camera) -> Array:
    """The points (H, W, 3) at `depth` (H, W) along the viewing axis; directions where it is 0."""
    y, x = np.indices(depth.shape) + 0.5
    pixels = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays = pixels @ np.linalg.inv(camera.K).T @ camera.camera_to_world[:3, :3].T
    return np.where(depth[..., None] > 0, camera.camera_to_world[:3, 3] + depth[..., None] * rays, rays)


def project(points: Array, is_finite: NDArray[np.bool_], camera: Camera) -> Array:
    """The pixels (H, W, 2) of points (H, W, 3), which are directions where not `is_finite` (H, W)."""
    relative = points - np.where(is_finite[..., None], camera.camera_to_world[:3, 3], 0)
    in_camera = relative @ camera.camera_to_world[:3, :3]
    depth = in_camera[..., 2]
    ahead = depth > 1e-9 * np.linalg.norm(in_camera, axis=-1)
    pixels = (in_camera @ camera.K.T)[..., :2] / np.where(ahead, depth, 1)[..., None]
    return np.where(ahead[..., None], np.clip(pixels, -FAR_OUTSIDE, FAR_OUTSIDE), FAR_OUTSIDE)
