"""Cameras of scene files see what Mitsuba's own would."""

import numpy as np
import pytest

from errors import BadInput
from render.backend import mi
from render.scene_file.load import FOV_WITHOUT_CAMERA, camera_framing, camera_of_sensor
from scenes.animation import Scene
from scenes.camera import directions, pixel_centres, project

LENSES = {axis: {"fov": 47.0, "fov_axis": axis} for axis in ("x", "y", "smaller", "larger", "diagonal")}
LENSES["focal_length"] = {"focal_length": "35mm"}
LOOK = mi.ScalarTransform4f().look_at([1, 2, 5], [0.2, 0.1, -1], [0.1, 1, 0])


@pytest.mark.parametrize(("width", "height"), [(32, 24), (16, 40), (20, 20), (1, 1)])
@pytest.mark.parametrize("lens", LENSES)
def test_rays_are_those_of_mitsubas_sensor(lens, width, height):
    described = {"type": "perspective", **LENSES[lens]}
    film = {"type": "hdrfilm", "width": width, "height": height}
    sensor = mi.load_dict({**described, "film": film, "to_world": LOOK})
    camera, notes = camera_of_sensor({**described, "to_world": np.array(LOOK.matrix)}, height, width)
    assert notes == []
    pixels = pixel_centres(height, width).reshape(-1, 2)
    place = mi.Point2f(*(pixels / [width, height]).T.astype(np.float32))
    theirs = np.array(sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))[0].d).reshape(3, -1).T
    view = Scene((), camera).view(0, height, width)
    ours = directions(pixels, view)
    ours /= np.linalg.norm(ours, axis=1, keepdims=True)
    np.testing.assert_allclose(ours, np.broadcast_to(theirs, ours.shape), atol=2e-6)
    np.testing.assert_allclose(view.camera_to_world[:3, 3], [1, 2, 5], atol=1e-6)


def test_what_a_camera_cannot_do_is_said():
    _, notes = camera_of_sensor({"to_world": np.diag([-1.0, 1, 1, 1])}, 4, 4)
    assert notes == ["the camera mirrors its image: not mirrored instead"]
    assert "centre" in camera_of_sensor({"principal_point_offset_x": 0.1}, 4, 4)[1][0]
    assert not camera_of_sensor({"principal_point_offset_x": 0.0}, 4, 4)[1]
    for lens in ({"fov": 0.0}, {"fov": 180.0}, {"fov": 40.0, "fov_axis": "z"}):
        with pytest.raises(BadInput, match="camera"):
            camera_of_sensor(lens, 4, 4)
    for matrix in (np.zeros((4, 4)), np.full((4, 4), np.nan)):
        with pytest.raises(BadInput, match="to_world"):
            camera_of_sensor({"to_world": matrix}, 4, 4)


@pytest.mark.parametrize("aspect", [1.0, 3.0])
def test_a_scene_without_camera_is_seen_whole(aspect):
    low, high = np.array([-1.0, 0, 2]), np.array([3.0, 1, 5])
    camera = camera_framing(low, high)
    corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    visible = project(corners, np.ones(8, bool), Scene((), camera).view(0, 100, int(100 / aspect)))
    assert camera.x_fov.at(0) == FOV_WITHOUT_CAMERA
    assert (visible > 0).all() and (visible < [100 / aspect, 100]).all()
