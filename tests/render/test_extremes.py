"""Every extreme scene renders to finite numbers that can be stored, and the unit of length does not matter."""

import numpy as np
import pytest

from datasets.clip import Clip
from datasets.writer import ClipWriter
from render.clip import Sampling, render_clip
from scenes.cornell import EXTREME_SCENES, rescaled
from scenes.registry import build_scene

SIZE = 24  # px
FRAMES = 2
SAMPLING = Sampling(2, 1, 32)


@pytest.mark.parametrize("name", EXTREME_SCENES)
def test_extreme_scene_becomes_a_clip(name, tmp_path):
    scene = build_scene(name, 5, FRAMES)
    with ClipWriter(tmp_path / "000") as writer:
        for channels, seconds in render_clip(scene, FRAMES, SIZE, SIZE, SAMPLING, 5):
            assert all(np.isfinite(array).all() for array in channels.values())
            assert all((array >= 0).all() for name, array in channels.items() if "direct" in name)
            writer.add(channels, seconds)
        writer.finish({"noisy_spp": 1, "reference_spp": 32, "meshes": [s.name for s in scene.shapes]}, {})
    clip = Clip(tmp_path / "000")
    assert not any(clip.facts["nonfinite"].values()) and np.isfinite(clip.exposure)
    for frame in range(FRAMES):
        assert np.isfinite(clip.reference(frame)).all()
        assert clip.view(frame).object_to_world.shape == (len(scene.shapes), 4, 4)
    if name == "extremes-sky":
        assert clip.exposure == 1 and clip.reference(0).min() > 0
        assert np.abs(clip.motion_to(1, 0)).max() > 0.1  # the sky moves with its directions
    if name == "extremes-light":
        assert np.isin(clip.read("emission", 0), (0, 1e5)).all()  # not clamped to what float16 holds
    if name == "extremes-mirrors":
        assert clip.read("roughness", 0).min() == 0


@pytest.mark.parametrize("factor", [1e-3, pytest.param(1e4, marks=pytest.mark.slow)])
def test_units_do_not_matter(factor):
    """The same samples in other units: the same picture and motion, depth times the factor."""
    scene = build_scene("cornell_box_moving", 5, FRAMES)
    clips = [render_clip(s, FRAMES, SIZE, SIZE, Sampling(1, 1, 64), 5) for s in (scene, rescaled(scene, factor))]
    plain, other = (list(clip)[-1][0] for clip in clips)
    same = plain["mesh_id"] == other["mesh_id"]
    assert same.mean() > 0.99
    np.testing.assert_allclose(other["depth"][same], plain["depth"][same] * factor, rtol=1e-4)
    np.testing.assert_allclose(other["motion"][same[..., 0]], plain["motion"][same[..., 0]], atol=2e-3)
    for name in ("direct_reference", "indirect_reference"):
        assert other[name].mean() == pytest.approx(plain[name].mean(), rel=0.01)
