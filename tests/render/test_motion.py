"""Cameras and motion vectors against Mitsuba's own camera and its ray tracer."""

import numpy as np
import pytest

from render.backend import mi
from render.motion import dual_motion_vectors
from render.stage import Stage
from scenes.camera import FAR_OUTSIDE, View, intrinsics, look_at, motion_vectors, pixel_centres, project
from scenes.registry import build_scene
from tests.helpers.rendering import posed_surfaces


def homogeneous_projection(points: np.ndarray, view: View) -> np.ndarray:
    """Pixels of world points by one 3 x 4 matrix: the textbook form, independent of `project`."""
    matrix = view.K @ np.linalg.inv(view.camera_to_world)[:3]
    p = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1) @ matrix.T
    return p[..., :2] / p[..., 2:]


def primary_hits(stage: Stage, view: View) -> np.ndarray:
    """World positions (H, W, 3) that Mitsuba reports."""
    si = stage.mitsuba_scene.ray_intersect(stage.rays(view))
    return np.array(si.p, dtype=np.float64).T.reshape(stage.height, stage.width, 3)


def carry(points: np.ndarray, mesh_id: np.ndarray, source: View, target: View) -> np.ndarray:
    """Points (..., 3) moved with their meshes from `source`'s frame to `target`'s, by plain matrix inversion."""
    moved = points.copy()
    for m in np.unique(mesh_id[mesh_id > 0]):
        matrix = target.object_to_world[m - 1] @ np.linalg.inv(source.object_to_world[m - 1])
        on = mesh_id == m
        moved[on] = points[on] @ matrix[:3, :3].T + matrix[:3, 3]
    return moved


@pytest.mark.parametrize("frame", [1, 9, 17])
def test_hits_project_to_their_pixel_and_to_where_motion_points(stage, frame):
    now, previous, _, mesh_id, motion = posed_surfaces(stage, frame)
    points = primary_hits(stage, now)
    centres = pixel_centres(stage.height, stage.width)
    hit = mesh_id > 0
    assert np.abs(homogeneous_projection(points, now) - centres)[hit].max() < 0.01
    carried = carry(points, mesh_id, now, previous)
    expected = homogeneous_projection(carried, previous)
    in_front = (carried - previous.camera_to_world[:3, 3]) @ previous.camera_to_world[:3, 2] > 0
    assert np.abs(centres + motion - expected)[hit & in_front].max() < 0.01


def trace_pixels(stage: Stage, view: View, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mesh id (...) and world position (..., 3) of what is visible through pixel positions (..., 2), as posed."""
    si = stage.mitsuba_scene.ray_intersect(stage.rays(view, pixels.reshape(-1, 2)))
    shape = pixels.shape[:-1]
    return np.array(stage.mesh_id(si)).reshape(shape), np.array(si.p, dtype=np.float64).T.reshape(*shape, 3)


@pytest.mark.parametrize("frame", range(1, 24, 4))
def test_following_motion_meets_the_same_surface_point(stage, frame):
    """And where that is visible, dual motion is the same to the last bit."""
    now, previous, depth, mesh_id, motion = posed_surfaces(stage, frame)
    points = primary_hits(stage, now)
    target = pixel_centres(stage.height, stage.width) + motion

    stage.pose(frame - 1)
    carried = carry(points, mesh_id, now, previous)
    inside = ((target > 0) & (target < (stage.width, stage.height))).all(axis=-1)
    # By Mitsuba's shadow test. Surfaces that turned their back are hidden by themselves.
    eye = previous.camera_to_world[:3, 3]
    towards = mi.Vector3f(np.float32((carried - eye).reshape(-1, 3).T))
    hidden = stage.mitsuba_scene.ray_test(mi.Ray3f(mi.Point3f(*map(float, eye)), towards, 0.9999, 0.0, []))
    visible = inside & (mesh_id > 0) & ~np.array(hidden).reshape(mesh_id.shape)
    dual = dual_motion_vectors(stage, depth, mesh_id, motion, now, previous)
    assert np.array_equal(dual[visible | ~inside], motion[visible | ~inside])
    then_mesh, then_points = trace_pixels(stage, previous, target)
    assert visible.mean() > 0.5
    assert (then_mesh == mesh_id)[visible].all()
    back = carry(then_points, then_mesh, previous, now)
    footprint = depth / -now.K[0, 0]
    # A pixel covers more of a surface that is visible at a grazing angle; compare across the line of sight.
    sight = points - now.camera_to_world[:3, 3]
    across = np.linalg.norm(np.cross(back - points, sight / np.linalg.norm(sight, axis=-1, keepdims=True)), axis=-1)
    assert (across < footprint)[visible].all()


@pytest.mark.parametrize(("clips", "fewest"), [(2, 1000), pytest.param(6, 3000, marks=pytest.mark.slow)])
def test_dual_motion_finds_the_background_where_motion_finds_the_occluder(clips, fewest):
    """Over so many clips: at least 95 % of the vectors land on the mesh that is visible now."""
    size = 96
    centres = pixel_centres(size, size)
    found = hidden_by_others = disoccluded = 0
    for seed in range(clips):
        stage = Stage(build_scene("cornell_box_moving", seed, frames=24), size, size)
        for frame in range(1, 24, 2):
            now, previous, depth, mesh_id, motion = posed_surfaces(stage, frame)
            stage.pose(frame - 1)
            dual = dual_motion_vectors(stage, depth, mesh_id, motion, now, previous)
            mask = np.abs(dual - motion).max(axis=-1) > 1 / 64
            target = (centres + dual)[mask]
            assert ((target >= 0) & (target <= size)).all()
            motion_mesh, _ = trace_pixels(stage, previous, centres + motion)
            dual_mesh, _ = trace_pixels(stage, previous, centres + dual)
            disoccluded += mask.sum()
            hidden_by_others += (motion_mesh != mesh_id)[mask].sum()
            found += (dual_mesh == mesh_id)[mask].sum()
    assert disoccluded > fewest
    assert hidden_by_others / disoccluded >= 0.98  # the rest are faces of a block that turned into view
    assert found / disoccluded >= 0.95


def test_background_moves_with_its_direction():
    """A camera that turns by half its field of view about the vertical axis moves the sky's centre to the border."""
    K, eye, a = intrinsics(40.0, 100, 100), np.zeros(3), np.radians(20)
    ahead = View(K, look_at(eye, np.array([0.0, 0, -1])), np.zeros((1, 4, 4)))
    turned = View(K, look_at(eye + 5, eye + 5 + np.array([np.sin(a), 0, -np.cos(a)])), np.zeros((1, 4, 4)))
    centre = np.array([[50.0, 50.0]])
    motion = motion_vectors(centre, np.zeros(1), np.zeros(1, int), ahead, turned)
    np.testing.assert_allclose(centre + motion, [[0, 50]], atol=1e-9)


def test_what_lies_behind_the_camera_projects_far_outside():
    view = View(intrinsics(60, 10, 10), np.eye(4), np.zeros((0, 4, 4)))
    points = np.array([[0.0, 0, -1], [0, 0, 0], [1, 1, 1e-12], [0, 0, 2]])
    pixels = project(points, np.ones(4, bool), view)
    assert np.isfinite(pixels).all()
    assert (pixels[:2] == FAR_OUTSIDE).all() and np.abs(pixels[2]).max() <= FAR_OUTSIDE
    np.testing.assert_allclose(pixels[3], [5, 5])
