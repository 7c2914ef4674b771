"""Temporal gradients: nothing where nothing changes, and the change of noise-free light on average."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from datasets.channels import HIT_CHANNELS, STRATUM
from render.clip import Sampling, render_clip
from render.gbuffer import render_gbuffer
from render.gradient import GradientSamples, pixel_of_each_stratum, sample_luminance
from render.path import PathTracer, PosedFrame, SampleRange
from render.stage import Stage
from scenes.animation import RigidMotion, Track, frozen
from scenes.cornell import cornell_box
from scenes.registry import build_scene

SIZE = 32


def samples_of(tracer: PathTracer, frame: int, seed: int) -> GradientSamples:
    """Samples of a frame for which the stage is posed; the same `seed` draws and chooses them."""
    stage = tracer.stage
    view = stage.view(frame)
    light = np.add(*tracer.radiance(stage.rays(view), seed, 1))
    return GradientSamples.of(render_gbuffer(stage, view), light, view, stage.poses, SampleRange(seed, 1), seed)


@given(st.integers(1, 20), st.integers(1, 20), st.integers(0, 99))
def test_every_stratum_has_one_sample(height, width, seed):
    row, column = np.divmod(pixel_of_each_stratum(height, width, seed), width)
    strata = {(r // STRATUM, c // STRATUM) for r, c in zip(row, column, strict=True)}
    assert len(strata) == len(row) == -(-height // STRATUM) * -(-width // STRATUM)
    assert (row < height).all() and (column < width).all()


def test_all_places_in_a_stratum_are_taken_alike():
    counts = np.bincount(np.concatenate([pixel_of_each_stratum(3, 3, seed) for seed in range(900)]), minlength=9)
    assert counts.min() > 60 and counts.max() < 140  # 100 each, standard deviation 9.4


@pytest.mark.parametrize("name", ["cornell_box", pytest.param("room-5", marks=pytest.mark.slow)])
def test_shading_an_unchanged_scene_anew_changes_no_bit(name):
    tracer = PathTracer(Stage(build_scene(name, 3, 24), SIZE, SIZE))
    samples = samples_of(tracer, 0, seed=7)
    shaded = samples._replace(poses=-1).gradient(tracer, tracer.stage.view(0))  # as if something had changed
    at = shaded.reshape(-1, 2)[samples.pixel]
    hit = samples.mesh_id > 0
    assert (shaded[..., 0] == 0).all()
    assert np.array_equal(at[hit, 1], samples.luminance[hit]) and samples.luminance.max() > 0
    assert (samples.gradient(tracer, tracer.stage.view(0)) == 0).all()  # nor is anything shaded


def test_a_camera_that_moves_alone_changes_no_diffuse_light():
    tracer = PathTracer(Stage(build_scene("cornell_box", 3, 24), SIZE, SIZE))
    samples = samples_of(tracer, 4, seed=1)
    difference, largest = np.moveaxis(samples.gradient(tracer, tracer.stage.view(5)), -1, 0)
    lit = largest > 0
    assert lit.sum() > 0.6 * len(samples.pixel)
    # Rounding may flip whether a ray just misses something.
    assert (np.abs(difference[lit]) < 1e-3 * largest[lit]).mean() > 0.98


def test_gradients_average_to_the_change_of_noise_free_light():
    """A lamp that dims by 40 % and moves: in blocks of pixels, against the difference of two references."""
    scene = cornell_box(np.random.default_rng(0), 2)
    *rest, lamp = scene.shapes
    dims = Track(lamp.radiance.at(0) * np.array([[1.0], [0.6]]))
    slides = RigidMotion(Track(np.array([[0.0, 0.99, 0.0], [0.3, 0.99, 0.2]])), lamp.motion.angle)
    shapes = (*rest, replace(lamp, radiance=dims, motion=slides))
    stage = Stage(replace(scene, shapes=shapes, camera=frozen(scene.camera)), SIZE, SIZE)
    references = [sample_luminance(PosedFrame(stage, frame).reflected(9, 1024).reshape(-1, 3)) for frame in (0, 1)]
    lamp_id = len(scene.shapes)
    visible = [render_gbuffer(stage, stage.view(frame))["mesh_id"].ravel() for frame in (0, 1)]

    tracer = PathTracer(stage)
    stage.pose(0)
    pairs = [samples_of(tracer, 0, seed) for seed in range(150)]
    stage.pose(1)
    images = [samples.gradient(tracer, stage.view(1)).reshape(-1, 2) for samples in pairs]
    pixel = np.concatenate([samples.pixel for samples in pairs])
    found = np.concatenate([image[samples.pixel, 0] for image, samples in zip(images, pairs, strict=True)])
    expected = (references[1] - references[0])[pixel]
    wall = (visible[0] != lamp_id)[pixel] & (visible[1] != lamp_id)[pixel]
    block = (pixel // SIZE // 8 * 4 + pixel % SIZE // 8)[wall]
    error = (found - expected)[wall]
    blocks = [error[block == b] for b in range(16)]
    z = np.array([each.mean() / (each.std() / np.sqrt(each.size)) for each in blocks])
    assert np.abs(z).max() < 4 and (np.abs(z) < 2).mean() > 0.7
    assert np.abs(expected[wall].mean()) > 0.2 * np.abs(references[0].mean())
    # The same random numbers on both sides leave far less noise than two independent frames would.
    assert found.std() < 0.5 * np.std(np.concatenate([samples.luminance for samples in pairs])) * np.sqrt(2)


def test_hidden_samples_leave_none():
    """What a moving block covers is not shaded anew: gradients stand on the mesh that their samples were on."""
    tracer = PathTracer(Stage(build_scene("cornell_box_moving", 3, 24), 64, 64))
    tracer.stage.pose(8)
    samples = samples_of(tracer, 8, seed=1)
    tracer.stage.pose(14)
    gradient = samples.gradient(tracer, tracer.stage.view(14))
    covered = render_gbuffer(tracer.stage, tracer.stage.view(14))["mesh_id"].ravel()[samples.pixel] != samples.mesh_id
    assert covered.sum() > 10
    assert 0.5 * len(samples.pixel) < (gradient[..., 1] != 0).sum() < len(samples.pixel) - 0.5 * covered.sum()


@pytest.fixture(scope="module")
def clip():
    scene = build_scene("cornell_box_moving", 3, 24)
    return [arrays for arrays, _ in render_clip(scene, 3, SIZE, SIZE, Sampling(2, 1, 2), 1)]


def test_a_clip_begins_without_gradients_and_motion(clip):
    assert not any(clip[0][name].any() for name in ("gradient", "shadow_motion", "reflection_motion"))
    for frame in clip[1:]:
        difference, largest = np.moveaxis(frame["gradient"], -1, 0)
        assert (largest >= np.abs(difference)).all() and (difference != 0).any()


@pytest.mark.parametrize("left_out", [{"gradient"}, {*HIT_CHANNELS}, {"shadow_motion", "reflection_motion"}])
def test_channels_cost_no_other_a_bit(clip, left_out):
    names = [name for name in clip[0] if name not in left_out]
    without = render_clip(build_scene("cornell_box_moving", 3, 24), 3, SIZE, SIZE, Sampling(2, 1, 2), 1, names)
    for frame, (arrays, seconds) in zip(clip, without, strict=True):
        assert set(arrays) == set(names) and not left_out & set(seconds)
        assert all(frame[name].tobytes() == arrays[name].tobytes() for name in names)


def test_gradients_are_of_the_first_realisation_and_hits_of_each(clip):
    alone = render_clip(build_scene("cornell_box_moving", 3, 24), 3, SIZE, SIZE, Sampling(1, 1, 2), 1)
    for frame, (arrays, _) in zip(clip, alone, strict=True):
        assert np.array_equal(frame["gradient"], arrays["gradient"])
        assert all(not np.array_equal(*frame[name]) for name in HIT_CHANNELS)
