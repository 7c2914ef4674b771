"""The camera of a scene file, and one for files that have none."""

from typing import Any

import numpy as np

from errors import BadInput
from render.backend import mi
from render.loading import reason
from scenes.animation import Camera, Track
from scenes.camera import Array

FOV_WITHOUT_CAMERA = 50.0  # degrees


def camera_of_sensor(sensor: dict[str, Any], height: int, width: int) -> tuple[Camera, list[str]]:
    """The camera at rest of a perspective sensor's dictionary, for images of this size, and what it cannot do.

    Where the sensor states its field of view for another axis than x, it holds for that axis here too. Raises BadInput
    where it has none.
    """
    film = {"type": "hdrfilm", "width": width, "height": height}
    lens = {key: value for key, value in sensor.items() if key in ("fov", "fov_axis", "focal_length")}
    try:
        loaded = mi.load_dict({"type": "perspective", "film": film, **lens})
    except RuntimeError as error:
        raise BadInput(f"the camera cannot be used: {reason(error)}") from None
    x_fov = float(np.array(mi.traverse(loaded)["x_fov"]).ravel()[0])
    to_world = np.asarray(sensor.get("to_world", np.eye(4)), np.float64)
    if not np.isfinite(to_world).all() or np.linalg.det(to_world[:3, :3]) == 0:
        raise BadInput(f"the camera cannot be used: its to_world is {to_world.tolist()}")
    axes = to_world[:3, :3] / np.linalg.norm(to_world[:3, :3], axis=0)
    eye = to_world[:3, 3]
    notes = []
    if np.linalg.det(axes) < 0:
        notes.append("the camera mirrors its image: seen the right way round instead")
    if "principal_point_offset_x" in sensor or "principal_point_offset_y" in sensor:
        notes.append("the camera's principal point is off centre: in the centre instead")
    camera = Camera(
        Track.constant(eye), Track.constant(eye + axes[:, 2]), Track.constant(x_fov), Track.constant(axes[:, 1])
    )
    return camera, notes


def camera_that_sees(low: Array, high: Array) -> Camera:
    """A camera at rest before the box from `low` (3,) to `high` (3,), a little above, that has all of it in view."""
    centre = (low + high) / 2
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-6)
    away = np.array([0.3, 0.25, 1.0])
    distance = radius / np.sin(np.radians(FOV_WITHOUT_CAMERA) / 2)
    eye = centre + away / np.linalg.norm(away) * distance
    return Camera(Track.constant(eye), Track.constant(centre), Track.constant(FOV_WITHOUT_CAMERA))
