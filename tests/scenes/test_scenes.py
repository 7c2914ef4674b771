"""Scenes are deterministic data, smooth in time, and nothing in them touches."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from errors import BadInput
from scenes.camera import cross
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


@settings(max_examples=30)
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


def test_unknown_scene_names_the_known():
    with pytest.raises(BadInput, match="cornell_box_moving"):
        build_scene("cornel", 0, 1)


@pytest.mark.parametrize("shape", [(3,), (5, 3), (2, 4, 3)])
def test_cross_products_are_those_of_numpy_bit_for_bit(shape):
    a, b = np.random.default_rng(0).normal(0, 10, (2, *shape))
    assert np.array_equal(cross(a, b), np.cross(a, b))
