"""Scenes are deterministic data, smooth in time, and nothing in them touches."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from errors import BadInput
from scenes.animation import Track
from scenes.camera import intrinsics, inverse_pose, look_at
from scenes.glass import GLASS_SCENES
from scenes.registry import SCENES, build_scene
from tests.helpers.scenes import FRAMES, SEEDS


def placed(scene, name, frame):
    """Vertices (V, 3) of the shape with that name, where they are in a frame."""
    shape = next(shape for shape in scene.shapes if shape.name == name)
    matrix = shape.motion.matrix(frame)
    return shape.mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize("name", sorted(SCENES.keys() - GLASS_SCENES.keys()))  # glass has no random flights
def test_same_seed_same_scene(name):
    a, b, other = (build_scene(name, seed, FRAMES).view(7.5, 64, 64) for seed in (5, 5, 6))
    assert all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))
    assert not np.array_equal(a.camera_to_world, other.camera_to_world)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, frames=st.integers(1, 60))
@pytest.mark.parametrize("name", ["cornell_box", "cornell_box_moving"])
def test_nothing_touches(name, seed, frames):
    scene = build_scene(name, seed, frames)
    for frame in np.linspace(0, frames - 1, 9):
        short, tall = (placed(scene, name, frame) for name in ("short-block", "tall-block"))
        for block in (short, tall):
            assert (np.abs(block) <= 1 + 1e-9).all() and (np.abs(block[:, [0, 2]]) < 0.99).all()
        if name == "cornell_box_moving":
            assert tall[:, 2].max() < short[:, 2].min()  # each keeps to its lane
        eye = scene.camera.eye.at(frame)
        assert (np.abs(eye) < 1).all() and eye[2] > short[:, 2].max()
        assert placed(scene, "light", frame)[:, 1] == pytest.approx(0.99)


def test_moving_box_moves_rigidly_and_its_light_changes():
    scene = build_scene("cornell_box_moving", 1, FRAMES)
    assert scene.moves() and not build_scene("cornell_box", 1, FRAMES).moves()
    for name in ("short-block", "tall-block", "light"):
        a, b = (placed(scene, name, frame) for frame in (0, 13))
        assert np.abs(a - b).max() > 0.01
        distances = [np.linalg.norm(v[:, None] - v[None], axis=-1) for v in (a, b)]
        np.testing.assert_allclose(*distances, atol=1e-12)
    light = next(shape for shape in scene.shapes if shape.radiance is not None)
    assert not np.array_equal(light.radiance.at(0), light.radiance.at(13))


def test_track_passes_through_its_keys_without_jumps():
    track = Track(np.array([[0.0, 1], [2, -1], [1, 5], [7, 7]]), last=30)
    np.testing.assert_allclose([track.at(10 * k) for k in range(4)], track.keys, atol=1e-12)
    dense = np.array([track.at(t) for t in np.linspace(-3, 33, 3601)])
    steps = np.diff(dense, axis=0)
    assert np.abs(np.diff(steps[301:-301], axis=0)).max() < 1e-4  # velocity is continuous
    assert (steps[:290] == 0).all() and (steps[-290:] == 0).all()  # the ends are held


def test_camera_matrices():
    matrix = look_at(np.array([1.0, 2, 3]), np.array([-1.0, 0.5, 0]))
    np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1)
    np.testing.assert_allclose(inverse_pose(matrix) @ matrix, np.eye(4), atol=1e-12)
    K = intrinsics(90, 48, 64)
    assert -K[0, 0] == pytest.approx(32) and K[0, 2] == 32 and K[1, 2] == 24


def test_unknown_scene_names_the_known():
    with pytest.raises(BadInput, match="cornell_box_moving"):
        build_scene("cornel", 0, 1)
