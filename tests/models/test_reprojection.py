"""Reprojection against a slow version in float64, and the kernel against PyTorch."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.frame import Frame, read_frame
from models.history.geometry import GBuffer
from models.history.reprojection import reproject
from tests.helpers.frames import MESHES, flat_frame
from tests.helpers.windows import window

pytestmark = pytest.mark.usefixtures("implementation")


def naive_reproject(frame: Frame, history: np.ndarray, mesh_then: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """SVGF §4.1's taps pixel by pixel in float64, on a wall where only mesh ids differ."""
    mesh = frame.mesh_id[0, 0].numpy()
    motion = frame.motion[0].numpy().astype(float)
    out = np.zeros(frame.size)
    has_history = np.zeros(frame.size, bool)
    for p in np.ndindex(frame.size):
        place = p + motion[::-1, *p]
        nearest = tuple(np.floor(place + 0.5).astype(int))
        box = [q for q in window(frame.size, nearest, 1) if mesh_then[q] == mesh[p]]
        first = np.floor(place)
        taps = {q: np.prod(1 - np.abs(place - q)) for q in box if ((q >= first) & (q <= first + 1)).all()}
        if taps:
            lost = 1 - sum(taps.values())
            out[p] = sum((weight + lost / len(taps)) * history[q] for q, weight in taps.items())
        elif box:
            out[p] = np.mean([history[q] for q in box])
        has_history[p] = bool(box)
    return out, has_history


@settings(max_examples=60, deadline=None)
@given(
    size=st.tuples(st.integers(1, 7), st.integers(1, 7)),
    motion=st.tuples(st.integers(-48, 48), st.integers(-48, 48)),
    seed=st.integers(0, 9999),
)
def test_reprojection_equals_the_naive_version(size, motion, seed):
    """At any motion in sixteenths of a pixel."""
    rng = np.random.default_rng(seed)
    now, then = rng.integers(1, 3, (2, *size))
    frame = flat_frame(*size, (motion[0] / 16, motion[1] / 16), mesh_id=torch.from_numpy(now)[None, None])
    before = flat_frame(*size, mesh_id=torch.from_numpy(then)[None, None])
    values = rng.uniform(0, 1, size)
    history, has_history = reproject(frame, torch.from_numpy(values).float()[None, None], GBuffer.of(before))
    expected, expected_valid = naive_reproject(frame, values, then)
    np.testing.assert_array_equal(has_history[0, 0].numpy(), expected_valid)
    np.testing.assert_allclose(history[0, 0].numpy(), expected, atol=1e-5)


def test_taps_of_another_depth_or_normal_are_invalid():
    frame, turned = flat_frame(5, 5), flat_frame(5, 5)
    turned.channels["normal"] = turned.normal.roll(1, dims=1)
    for other in (flat_frame(5, 5, depth=1.9), turned):
        assert not reproject(frame, torch.zeros(1, 1, 5, 5), GBuffer.of(other))[1].any()


@pytest.mark.parametrize("number", [MESHES + 1.0, 5000.0, -1.0, -5000.0, 1e35, -1e35])
def test_meshes_without_a_pose_stand_still(number):
    """As a mesh that has a pose and does not move, while the last one moves."""
    still, other = (flat_frame(12, 20, (1.0, 0.5), mesh_id=torch.full((1, 1, 12, 20), x)) for x in (1.0, number))
    poses = still.previous.object_to_world.clone()
    poses[:, -1, 2, 3] = 1.0
    moved = replace(still.previous, object_to_world=poses)
    history = torch.rand(1, 2, 12, 20, generator=torch.Generator().manual_seed(0))
    expected, actual = (
        reproject(replace(frame, previous=moved), history, GBuffer.of(frame)) for frame in (still, other)
    )
    assert expected[1].float().mean() > 0.8
    assert torch.equal(actual[0], expected[0]) and torch.equal(actual[1], expected[1])


def test_background_has_the_history_of_background():
    sky = flat_frame(4, 4, depth=0.0, mesh_id=torch.zeros(1, 1, 4, 4))
    sky.channels["normal"] = torch.zeros(1, 3, 4, 4)
    assert reproject(sky, torch.zeros(1, 1, 4, 4), GBuffer.of(sky))[1].all()
    assert not reproject(flat_frame(4, 4), torch.zeros(1, 1, 4, 4), GBuffer.of(sky))[1].any()


def test_reprojection_follows_a_mesh_that_moves(moving_clip):
    """Visible surfaces have a history, and nothing is ever fetched from another mesh."""
    names = ("normal", "depth", "mesh_id", "motion", "dual_motion")
    for index in range(1, moving_clip.frames):
        frame, before = (read_frame(moving_clip, i, names) for i in (index, index - 1))
        position = frame.motion + torch.stack(torch.meshgrid(torch.arange(64), torch.arange(64), indexing="xy"))[None]
        inside = ((position >= 0) & (position <= 63)).all(dim=1, keepdim=True)
        hidden = (frame.dual_motion - frame.motion).abs().amax(dim=1, keepdim=True) > 1 / 64
        history, has_history = reproject(frame, before.mesh_id, GBuffer.of(before))
        assert has_history[inside & ~hidden].float().mean() > 0.99
        torch.testing.assert_close(history[has_history], frame.mesh_id[has_history])
    # Seven frames at once: disoccluded strips too wide for any tap.
    last = read_frame(moving_clip, 7, names[:-1], previous=0)
    first = read_frame(moving_clip, 0, names[:-1])
    history, has_history = reproject(last, first.mesh_id, GBuffer.of(first))
    torch.testing.assert_close(history[has_history], last.mesh_id[has_history])
    assert 0.005 < (~has_history).float().mean() < 0.3


def test_the_gradient_is_the_transpose(moving_clip):
    """What is fetched is linear in the history: products with it on either side agree."""
    names = ("normal", "depth", "mesh_id", "motion")
    generator = torch.Generator().manual_seed(0)
    for index, previous in ((1, 0), (4, 3), (7, 0)):
        frame = read_frame(moving_clip, index, names, previous=previous)
        then = GBuffer.of(read_frame(moving_clip, previous, names))
        history = torch.randn(1, 2, 64, 64, generator=generator, requires_grad=True)
        other = torch.randn(1, 2, 64, 64, generator=generator)
        weight = torch.randn(1, 2, 64, 64, generator=generator)
        (gradient,) = torch.autograd.grad(reproject(frame, history, then)[0], history, weight)
        fetched, _ = reproject(frame, other, then)
        products = ((fetched * weight).double().sum(), (other * gradient).double().sum())
        torch.testing.assert_close(*products, rtol=1e-6, atol=0)
