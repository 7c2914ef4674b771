"""Scenes with other things in them run the same kernels."""

import gc

import numpy as np
import pytest

from render.backend import VARIANT, dr
from render.path import PosedFrame
from render.stage import Stage
from scenes.colours import bitmap, diffuse_bsdf
from scenes.registry import build_scene
from tests.render.test_materials import textured_square

LARGE = 3000  # operations; G-buffer and path tracing have several times as many, what prepares data has far fewer


def large_kernels(scene: str) -> set[str]:
    """The kernels of a frame's G-buffer and light, by their hashes."""
    gc.collect()  # objects of other scenes count
    stage = Stage(build_scene(scene, 0, 4), 8, 8)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        PosedFrame(stage, 0).reflected(1, 1)
        history = dr.kernel_history()
    compiled = [kernel for kernel in history if kernel["type"] == dr.KernelType.JIT]
    return {kernel["hash"] for kernel in compiled if kernel["operation_count"] > LARGE}


@pytest.mark.skipif(VARIANT != "llvm_ad_rgb", reason="counts the kernels of the CPU variant")
@pytest.mark.slow
def test_scenes_share_their_kernels():
    # Between them these have one to four lamps, and all kinds of materials with numbers and bitmaps.
    kernels = {scene: large_kernels(scene) for scene in ("cornell_box", "room-0", "room-1", "room-3", "room-7")}
    assert all(kernels.values())
    assert len(set.union(*kernels.values())) == len(kernels["room-0"])


def test_placement_of_textures_moves_into_texture_coordinates():
    placement = np.array([[0.0, 2.0, 0.3], [-3.0, 0.0, 0.1], [0, 0, 1]])
    scene = textured_square(diffuse_bsdf(bitmap(np.full((2, 2, 3), 0.5, np.float32)) | {"to_uv": placement}))
    (square,) = scene.shapes
    square.mesh.vertex_normals = np.tile([0.6, 0, 0.8], (4, 1))
    (placed,) = Stage(scene, 8, 8).scene.shapes
    expected = square.mesh.visual.uv @ placement[:2, :2].T + placement[:2, 2]
    np.testing.assert_allclose(placed.mesh.visual.uv, expected)
    assert "to_uv" not in placed.bsdf["reflectance"]
    assert (placed.mesh.vertex_normals == [0.6, 0, 0.8]).all()
