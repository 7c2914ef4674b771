"""BMFR against numpy's padding and least squares, block by block."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.cameras import Cameras
from eval.bench.synthetic_frames import synthetic_frame
from models.filters import bmfr
from models.filters.baselines import Accumulated
from models.filters.bmfr import BMFR, Blocks
from tests.helpers.frames import chain, flat_frame, play, run
from tests.models.conftest import IMPLEMENTATIONS

pytestmark = pytest.mark.usefixtures("one_thread")
EXAMPLES = settings(deadline=None)
SIZES = st.tuples(st.integers(1, 70), st.integers(1, 70))
OFFSETS = st.tuples(st.integers(0, 31), st.integers(0, 31))


def to_torch(array):
    return torch.from_numpy(np.ascontiguousarray(array))[None]


def scene(rng, height, width, share=0.8):
    """Irradiance and normals (3, H, W), depth (H, W), 0 for background, and axes (3, 3) of some camera."""
    depth = np.float32((1 + rng.random((height, width))) * (rng.random((height, width)) < share))
    normal = np.float32(rng.standard_normal((3, height, width)))
    light = np.float32(10 * rng.random((3, height, width)) ** 4)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return light, normal, depth, turn @ np.linalg.inv([[-50, 0, width / 2], [0, -60, height / 2], [0, 0, 1]])


def regress(light, normal, depth, axes, noise, offset):
    """As arrays."""
    tensors = (to_torch(array) for array in (light, normal, depth[None], axes))
    return bmfr.regress(*tensors, noise, offset)[0].double().numpy()


# --- The grid ---------------------------------------------------------------------------------------------------------


def test_the_grid_moves_from_frame_to_frame_and_returns():
    offsets = [bmfr.grid_offset(number) for number in range(32)]
    assert offsets[:16] == offsets[16:] and len(set(offsets[:16])) == 16
    assert all(0 <= place < 32 for offset in offsets for place in offset)
    for (y, x), (to_y, to_x) in itertools.pairwise(offsets):
        apart = [min(step % 32, -step % 32) for step in (to_y - y, to_x - x)]
        assert max(apart) >= 4  # no pixel stays close to a border
    for axis in range(2):
        assert np.ptp(np.sort(np.array(offsets)[:16, axis]) - 2 * np.arange(16)) <= 4  # evenly spread


@EXAMPLES
@given(size=SIZES, offset=OFFSETS, seed=st.integers(0, 9999))
def test_blocks_cover_the_image_and_mirror_it(size, offset, seed):
    image = np.random.default_rng(seed).random((2, 3, *size))
    blocks = Blocks(size, offset)
    split = blocks.split(torch.from_numpy(image))
    assert torch.equal(blocks.join(split), torch.from_numpy(image))
    down, across = (-(-(length + before) // 32) for length, before in zip(size, offset, strict=True))
    behind = [count * 32 - length - o for count, length, o in zip((down, across), size, offset, strict=True)]
    padding = [(0, 0), (0, 0), *zip(offset, behind, strict=True)]
    padded = np.pad(image, padding, mode="symmetric")
    expected = padded.reshape(2, 3, down, 32, across, 32).transpose(0, 2, 4, 3, 5, 1).reshape(2, -1, 1024, 3)
    assert np.array_equal(split.numpy(), expected)


# --- The regression ---------------------------------------------------------------------------------------------------


def fitted_by_numpy(light, normal, depth, axes, noise, offset):
    """Blocks gathered pixel by pixel from a mirrored image, background left out, solved by numpy."""
    height, width = depth.shape
    out = np.zeros_like(light, dtype=float)
    y, x = np.mgrid[:height, :width] + 0.5
    where = np.einsum("ij,jhw->ihw", axes, np.stack([x, y, np.ones_like(x)])) * depth.astype(float)

    def mirrored(place, size):
        return np.pad(np.arange(size), 64, mode="symmetric")[place + 64]

    for top in range(-offset[0], height, 32):
        for left in range(-offset[1], width, 32):
            places = [(top + p // 32, left + p % 32) for p in range(1024)]
            pixels = [(mirrored(y, height), mirrored(x, width)) for y, x in places]
            surface = [pixel for pixel in pixels if depth[pixel] > 0]
            if not surface:
                continue
            spots = np.array([where[:, *pixel] for pixel in surface])
            low = spots.min(axis=0)
            extent = np.ptp(spots, axis=0)
            extent = np.maximum(extent, 1e-3 * extent.max())
            rows = np.zeros((1024, 10))
            target = np.zeros((1024, 3))
            for row, pixel in enumerate(pixels):
                if depth[pixel] > 0:
                    p = (where[:, *pixel] - low) / np.where(extent > 0, extent, 1)
                    rows[row] = [1, *normal[:, *pixel], *p, *p**2]
                    target[row] = light[:, *pixel]
            fit = rows @ np.linalg.lstsq(rows + noise, target, rcond=None)[0]
            for row, (y, x) in enumerate(places):
                if 0 <= y < height and 0 <= x < width:
                    out[:, y, x] = fit[row]
    return out


@EXAMPLES
@given(size=SIZES, offset=OFFSETS, share=st.sampled_from([0.0, 0.003, 0.05, 0.8, 1.0]), seed=st.integers(0, 9999))
def test_blocks_are_fitted_as_numpy_does(size, offset, share, seed):
    image = scene(np.random.default_rng(seed), *size, share)
    noise = bmfr.feature_noise(seed)
    expected = fitted_by_numpy(*image, noise.numpy(), offset)
    for implementation in IMPLEMENTATIONS.values():
        with implementation():
            np.testing.assert_allclose(regress(*image, noise, offset), expected, rtol=1e-5, atol=1e-5)


def test_noise_is_small_of_mean_0_and_always_the_same():
    noise = bmfr.feature_noise(3)
    assert torch.equal(noise, bmfr.feature_noise(3)) and not torch.equal(noise, bmfr.feature_noise(4))
    assert (noise[:, 0] == 0).all() and noise.abs().max() <= 0.01
    assert noise[:, 1:].abs().mean().item() == pytest.approx(0.005, rel=0.05)
    assert abs(noise.mean().item()) < 3e-4


@pytest.mark.usefixtures("implementation")
def test_a_few_pixels_of_a_block_stay_in_range():
    """Fewer than there are features: noise alone does not let them be fitted one by one, nor leap out of range."""
    rng = np.random.default_rng(3)
    for number in range(50):
        light, normal, depth, axes = scene(rng, 32, 32, share=0.004)
        normal[:] = np.array([0, 0, -1])[:, None, None]
        surface = depth > 0
        if surface.any():
            fitted = regress(light, normal, depth, axes, bmfr.feature_noise(number), (0, 0))[:, surface]
            assert np.abs(fitted).max() < 2 * light[:, surface].max()


# --- The whole --------------------------------------------------------------------------------------------------------


def test_both_accumulations(monkeypatch):
    """The first is that of all denoisers; the second an even mean of ten frames, then exponential with 0.1."""
    inputs = []
    lights, fits = np.random.default_rng(0).random((2, 14))

    def regress(irradiance, *_):
        inputs.append(irradiance)
        return torch.full_like(irradiance, fits[len(inputs) - 1])

    monkeypatch.setattr(bmfr, "regress", regress)
    frames = [flat_frame(4, 5, irradiance=torch.full((1, 3, 4, 5), light)) for light in np.float32(lights)]
    outputs, state = play(BMFR(), frames)
    torch.testing.assert_close(inputs, run(Accumulated(), frames))
    shown = 0.0
    for n in range(14):
        shown += (fits[n] - shown) * max(0.1, 1 / (n + 1))
        torch.testing.assert_close(outputs[n], torch.full((1, 3, 4, 5), shown), rtol=1e-5, atol=0)
    assert state.frames == 14 and (state.pictures()["history length"] == 14).all()


def test_what_was_fitted_is_clipped_and_dropped_where_disoccluded(monkeypatch):
    fits = iter([-1.0, 3.0, float("inf")])
    monkeypatch.setattr(bmfr, "regress", lambda irradiance, *_: torch.full_like(irradiance, next(fits)))
    frames = chain([flat_frame(4, 8, motion) for motion in ((0.0, 0.0), (2.0, 0.0), (100.0, 0.0))])
    outputs = run(BMFR(), frames)
    assert (outputs[0] == 0).all()
    assert (outputs[1][..., :7] == 1.5).all() and (outputs[1][..., 7] == 3).all()
    assert torch.isfinite(outputs[2]).all() and (outputs[2] > 1e30).all()


@pytest.mark.usefixtures("implementation")
def test_the_same_frames_give_the_same_bits_and_far_from_the_origin_the_same_picture():
    """The regression depends on the camera's rotation alone; far away only reprojection rounds differently."""
    away = torch.eye(4, dtype=torch.float64)
    away[:3, 3] = torch.tensor([1e7, -3e6, 2e7])

    def moved(cameras):
        return Cameras(cameras.K, away @ cameras.camera_to_world, away @ cameras.object_to_world)

    frames = [synthetic_frame(index, 40, 50) for index in range(3)]
    far = [replace(frame, now=moved(frame.now), previous=moved(frame.previous)) for frame in frames]
    near, again, there = (run(BMFR(), sequence) for sequence in (frames, frames, far))
    torch.testing.assert_close(near, again, rtol=0, atol=0)
    torch.testing.assert_close(near, there, rtol=1e-3, atol=1e-4)
