"""Cameras are recovered from positions and headers, or not at all."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from denoise.cameras import in_the_world, is_own_space, view_of_header, view_of_positions
from scenes.camera import View, intrinsics, inverse_pose, look_at, pixel_centres, project, unproject
from tests.helpers.foreign import world_to_ndc

HEIGHT, WIDTH = 36, 64
SURFACE = np.ones((HEIGHT, WIDTH), bool)


def some_view(seed: int) -> View:
    rng = np.random.default_rng(seed)
    eye = rng.uniform(-3, 3, 3)
    return View(intrinsics(rng.uniform(20, 100), HEIGHT, WIDTH), look_at(eye, rng.uniform(4, 6, 3)), np.eye(4)[None])


def points_of(view: View, seed: int = 0) -> np.ndarray:
    depth = np.random.default_rng(seed).uniform(2, 9, (HEIGHT, WIDTH))
    return unproject(pixel_centres(HEIGHT, WIDTH), depth, view).astype(np.float32)


def assert_same(fitted_view: View | None, view: View, tolerance: float = 1e-3) -> None:
    assert fitted_view is not None
    np.testing.assert_allclose(fitted_view.camera_to_world, view.camera_to_world, atol=tolerance)
    np.testing.assert_allclose(fitted_view.K, view.K, atol=tolerance * WIDTH)


@given(st.integers(0, 10**6))
def test_positions_determine_the_camera(seed):
    view = some_view(seed)
    assert_same(view_of_positions(points_of(view), SURFACE), view)


def test_a_few_wrong_positions_are_ignored():
    view = some_view(1)
    positions = points_of(view)
    positions[::9, ::7] = 100
    positions[3, 4] = np.nan
    assert_same(view_of_positions(positions, SURFACE), view)


def test_left_handed_worlds_project_alike():
    mirrored = points_of(some_view(2)) * [1, 1, -1]
    fitted_view = view_of_positions(mirrored, SURFACE)
    assert fitted_view is not None
    np.testing.assert_allclose(project(mirrored, SURFACE, fitted_view), pixel_centres(HEIGHT, WIDTH), atol=1e-2)
    identity = fitted_view.camera_to_world @ inverse_pose(fitted_view.camera_to_world)
    np.testing.assert_allclose(identity, np.eye(4), atol=1e-9)


def test_positions_that_do_not_determine_a_camera():
    view = some_view(3)
    wall = unproject(pixel_centres(HEIGHT, WIDTH), np.full((HEIGHT, WIDTH), 3.0), view)  # a plane
    noise = np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3))
    for positions in (wall, noise, np.zeros_like(noise)):
        assert view_of_positions(positions.astype(np.float32), SURFACE) is None
    assert view_of_positions(points_of(view), ~SURFACE) is None


def windowed(left: int, top: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """A window as OpenEXR gives it."""
    return np.array([left, top], np.int32), np.array([left + width - 1, top + height - 1], np.int32)


@pytest.mark.parametrize("from_zero", [True, False])
def test_cameras_of_headers(from_zero):
    view = some_view(4)
    ndc = world_to_ndc(view, HEIGHT, WIDTH, from_zero)
    assert_same(view_of_header({"worldToNDC": ndc}, HEIGHT, WIDTH), view, 1e-4)
    cropped = {"displayWindow": windowed(0, 0, WIDTH, HEIGHT), "dataWindow": windowed(5, 3, 8, 6)}
    K = view.K - [[0, 0, 5], [0, 0, 3], [0, 0, 0]]
    assert_same(view_of_header({"worldToNDC": ndc, **cropped}, 6, 8), view._replace(K=K), 1e-4)
    assert view_of_header({}, HEIGHT, WIDTH) is None
    assert view_of_header({"worldToNDC": np.zeros((4, 4))}, HEIGHT, WIDTH) is None
    assert view_of_header({"worldToNDC": ndc * [[0.5, 1, 1, 1]]}, HEIGHT, WIDTH) is None  # oblong pixels


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_positions_in_the_cameras_own_space(dtype):
    view = some_view(5)
    world_to_camera = inverse_pose(view.camera_to_world)
    header = {"worldToCamera": world_to_camera.T}
    in_camera = points_of(view) @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
    for positions, is_own in ((in_camera, True), (points_of(view), False)):
        rounded = positions.astype(dtype).astype(np.float32)
        fitted = view_of_positions(rounded, SURFACE)
        assert fitted is not None
        assert is_own_space(fitted, header, rounded, SURFACE) == is_own_space(fitted, {}, rounded, SURFACE) == is_own
        fitted_view = in_the_world(fitted, header) if is_own else fitted
        assert_same(fitted_view, view, 1e-3 if dtype == np.float32 else 1e-2)
        for nothing in ({}, {"worldToCamera": np.zeros((4, 4))}):
            assert in_the_world(fitted, nothing) is None
            assert is_own_space(fitted, nothing, rounded, SURFACE) == is_own
