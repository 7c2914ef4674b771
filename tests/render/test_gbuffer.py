"""The G-buffer of scenes whose answer is known, and the proof that no frame compiles a kernel anew."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from render.clip import Sampling, render_clip
from render.gbuffer import render_gbuffer
from render.stage import Stage
from scenes.animation import Camera, RigidMotion, Scene, Shape, Track
from scenes.camera import pixel_centres, unproject
from scenes.registry import build_scene
from tests.helpers.rendering import first_gbuffer


@pytest.fixture(scope="module")
def square() -> Scene:
    """A grey unit square, 3 units before a camera that looks along -z, half its width in view; black sky around it."""
    mesh = trimesh.Trimesh(np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]]) / 2, [[0, 1, 2], [0, 2, 3]])
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}}
    shape = Shape("square", mesh, grey, radiance=Track.constant([1.0, 2.0, 3.0]))
    fov = np.degrees(2 * np.arctan(1 / 3))  # two units wide at the square's distance
    camera = Camera(Track.constant([0.0, 0, 3]), Track.constant([0.0, 0, 0]), Track.constant(fov))
    return Scene((shape,), camera)


def test_square_before_a_black_sky(square):
    buffer = first_gbuffer(square, 32, 32)
    hit = np.zeros((32, 32), bool)
    hit[8:24, 8:24] = True  # half the width, a quarter of the area, in the middle
    assert np.array_equal(buffer["mesh_id"][..., 0], hit)
    np.testing.assert_allclose(buffer["depth"][..., 0], 3 * hit, rtol=1e-6)
    np.testing.assert_allclose(buffer["normal"], hit[..., None] * [0, 0, 1.0], atol=1e-6)
    np.testing.assert_allclose(buffer["albedo"], np.where(hit[..., None], [0.2, 0.4, 0.6], 1), rtol=1e-6)
    np.testing.assert_allclose(buffer["emission"], hit[..., None] * [1.0, 2, 3], rtol=1e-6)
    assert (buffer["roughness"] == 1).all()


def test_normals_face_the_viewer_from_behind(square):
    buffer = first_gbuffer(replace(square, camera=replace(square.camera, eye=Track.constant([0.0, 0, -3]))), 16, 16)
    np.testing.assert_allclose(buffer["normal"][8, 8], [0, 0, -1], atol=1e-6)
    assert buffer["emission"].max() == 0  # lamps shine to one side


def test_smooth_mesh_keeps_and_turns_its_vertex_normals():
    """A sphere of unit normals moved and turned: normal = (p - centre) / radius, facets notwithstanding."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    white = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    motion = RigidMotion(Track(np.array([[0.0, 0, 0], [0.5, 0.25, 0]])), Track(np.array([0.0, 2.0])))
    camera = Camera(Track.constant([0.0, 0, 5]), Track.constant([0.0, 0, 0]), Track.constant(40.0))
    stage = Stage(Scene((Shape("ball", ball, white, motion=motion, smooth=True),), camera), 48, 48)
    for frame, centre in ((0, [0, 0, 0]), (1, [0.5, 0.25, 0])):
        stage.pose(frame)
        view = stage.view(frame)
        buffer = render_gbuffer(stage, view)
        hit = buffer["mesh_id"][..., 0] > 0
        expected = unproject(pixel_centres(48, 48), buffer["depth"][..., 0].astype(float), view) - centre
        expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
        assert hit.sum() > 300
        assert np.abs(buffer["normal"] - expected)[hit].max() < 5e-3  # facets are off by up to 0.03


def test_a_mesh_that_moves_without_turning_keeps_its_authored_normals(square):
    """Mitsuba would recompute them from the moved vertices."""
    plain, tilted = square.shapes[0].mesh, [0.6, 0, 0.8]
    mesh = trimesh.Trimesh(plain.vertices, plain.faces, vertex_normals=np.tile(tilted, (4, 1)), process=False)
    motion = RigidMotion(Track(np.array([[0.0, 0, 0], [0.1, 0, 0]])), Track.constant(0.0))
    shape = replace(square.shapes[0], mesh=mesh, motion=motion, smooth=True)
    stage = Stage(replace(square, shapes=(shape,)), 16, 16)
    for frame in (0, 1):
        stage.pose(frame)
        np.testing.assert_allclose(render_gbuffer(stage, stage.view(frame))["normal"][8, 8], tilted, atol=1e-6)


def test_colours_lie_on_their_walls(stage):
    stage.pose(0)
    buffer = render_gbuffer(stage, stage.view(0))
    for index, shape in enumerate(stage.scene.shapes):
        visible = buffer["albedo"][buffer["mesh_id"][..., 0] == index + 1]
        colour = np.broadcast_to(shape.bsdf["reflectance"]["value"], visible.shape)
        np.testing.assert_allclose(visible, colour, rtol=1e-5)


COUNT_COMPILATIONS = """
from render.backend import dr
from render.clip import Sampling, render_clip
from scenes.registry import build_scene
dr.set_flag(dr.JitFlag.KernelHistory, True)
scene = build_scene("cornell_box_moving", 5, 10)
for channels, _ in render_clip(scene, 10, 40, 40, Sampling(2, 1, 4), 0):
    kernels = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    print(len(kernels), sum(not k["cache_hit"] for k in kernels))
"""


@pytest.mark.slow
def test_no_kernel_is_recompiled_from_frame_to_frame(tmp_path):
    """In a new process with an empty kernel cache: all compilation happens before the first frame is out."""
    environment = os.environ | {"DRJIT_CACHE_DIR": str(tmp_path)}
    run = subprocess.run([sys.executable, "-c", COUNT_COMPILATIONS], capture_output=True, text=True, env=environment)
    assert run.returncode == 0, run.stderr
    frames = [tuple(map(int, line.split())) for line in run.stdout.split("\n") if line]
    assert len(frames) == 10
    assert frames[0][1] > 0  # the count can see a compilation
    for launched, compiled in frames[1:]:
        assert launched >= 4 and compiled == 0


def test_every_frame_is_posed_for_itself():
    """Frames have the same bytes in a longer clip: meshes and lights stand where they should, in the last one too."""
    scene = build_scene("cornell_box_moving", 3, 24)
    short, long = ([arrays for arrays, _ in render_clip(scene, n, 24, 24, Sampling(1, 1, 8), 0)] for n in (3, 5))
    for a, b in zip(short, long, strict=False):
        for name in a:
            np.testing.assert_array_equal(a[name], b[name], err_msg=name)
