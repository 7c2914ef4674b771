"""Reprojection against a slow version in float64, and the kernel against PyTorch."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.clip import Dataset
from datasets.frame import Frame, read_frame
from models import compiled
from models.history.geometry import GBuffer
from models.history.reprojection import reproject
from tests.helpers.frames import flat_frame


def naive_reproject(frame: Frame, history: np.ndarray, mesh_then: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """SVGF §4.1's taps pixel by pixel in float64, on a wall where only mesh ids differ."""
    height, width = frame.size
    mesh = frame.mesh_id[0, 0].numpy()
    motion = frame.motion[0].numpy().astype(float)
    out = np.zeros((height, width))
    has_history = np.zeros((height, width), bool)

    def valid(y, x, r, c):
        return 0 <= r < height and 0 <= c < width and mesh_then[r, c] == mesh[y, x]

    for y, x in np.ndindex(height, width):
        px = x + motion[0, y, x]
        py = y + motion[1, y, x]
        c0 = int(np.floor(px))
        r0 = int(np.floor(py))
        fx = px - c0
        fy = py - r0
        taps = [(r0 + j, c0 + i, (fy if j else 1 - fy) * (fx if i else 1 - fx)) for j in (0, 1) for i in (0, 1)]
        good = [(r, c, w) for r, c, w in taps if valid(y, x, r, c)]
        lost = sum(w for r, c, w in taps if not valid(y, x, r, c))
        if good:
            out[y, x] = sum((w + lost / len(good)) * history[r, c] for r, c, w in good)
            has_history[y, x] = True
            continue
        row = int(np.floor(py + 0.5))
        column = int(np.floor(px + 0.5))
        box = [(row + j, column + i) for j in (-1, 0, 1) for i in (-1, 0, 1)]
        values = [history[r, c] for r, c in box if valid(y, x, r, c)]
        if values:
            out[y, x] = np.mean(values)
            has_history[y, x] = True
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


def test_background_has_the_history_of_background():
    sky = flat_frame(4, 4, depth=0.0, mesh_id=torch.zeros(1, 1, 4, 4))
    sky.channels["normal"] = torch.zeros(1, 3, 4, 4)
    assert reproject(sky, torch.zeros(1, 1, 4, 4), GBuffer.of(sky))[1].all()
    assert not reproject(flat_frame(4, 4), torch.zeros(1, 1, 4, 4), GBuffer.of(sky))[1].any()


def test_reprojection_follows_a_mesh_that_moves(tiny):
    """Visible surfaces have a history, and nothing is ever fetched from another mesh."""
    clip = Dataset(tiny).clips("test")[1]
    names = ("normal", "depth", "mesh_id", "motion", "dual_motion")
    for index in range(1, clip.frames):
        frame, before = (read_frame(clip, i, names) for i in (index, index - 1))
        position = frame.motion + torch.stack(torch.meshgrid(torch.arange(64), torch.arange(64), indexing="xy"))[None]
        inside = ((position >= 0) & (position <= 63)).all(dim=1, keepdim=True)
        hidden = (frame.dual_motion - frame.motion).abs().amax(dim=1, keepdim=True) > 1 / 64
        history, has_history = reproject(frame, before.mesh_id, GBuffer.of(before))
        assert has_history[inside & ~hidden].float().mean() > 0.99
        torch.testing.assert_close(history[has_history], frame.mesh_id[has_history])
    # Seven frames at once: disoccluded strips too wide for any tap.
    last = read_frame(clip, 7, names[:-1], previous=0)
    first = read_frame(clip, 0, names[:-1])
    history, has_history = reproject(last, first.mesh_id, GBuffer.of(first))
    torch.testing.assert_close(history[has_history], last.mesh_id[has_history])
    assert 0.005 < (~has_history).float().mean() < 0.3


def test_compiled_reprojection_equals_pytorch_s(tiny):
    """On frames with moving meshes, moving cameras and disocclusions; a pixel in a thousand may sit on a limit."""
    clip = Dataset(tiny).clips("test")[1]
    names = ("direct", "indirect", "albedo", "normal", "depth", "mesh_id", "motion")
    for index in range(1, clip.frames):
        frame, before = (read_frame(clip, i, names) for i in (index, index - 1))
        history = torch.cat([before.irradiance("total"), before.depth], dim=1)
        fast, has_history = reproject(frame, history, GBuffer.of(before))
        with compiled.disabled():
            slow, expected = reproject(frame, history, GBuffer.of(before))
        assert (has_history != expected).float().mean() < 1e-3
        close = torch.isclose(fast, slow, rtol=1e-3, atol=1e-3).all(dim=1)
        assert close.float().mean() > 0.999


def test_the_gradient_is_the_transpose(tiny):
    """What is fetched is linear in the history: products with it on either side agree."""
    clip = Dataset(tiny).clips("test")[1]
    names = ("normal", "depth", "mesh_id", "motion")
    generator = torch.Generator().manual_seed(0)
    for index, previous in ((1, 0), (4, 3), (7, 0)):
        frame = read_frame(clip, index, names, previous=previous)
        then = GBuffer.of(read_frame(clip, previous, names))
        history = torch.randn(1, 2, 64, 64, generator=generator, requires_grad=True)
        other = torch.randn(1, 2, 64, 64, generator=generator)
        weight = torch.randn(1, 2, 64, 64, generator=generator)
        (gradient,) = torch.autograd.grad(reproject(frame, history, then)[0], history, weight)
        fetched, _ = reproject(frame, other, then)
        torch.testing.assert_close((fetched * weight).double().sum(), (other * gradient).double().sum())
