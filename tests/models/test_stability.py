"""Numerical stability of every registered denoiser, a new one included.

Finite in, finite out; nothing below zero; a pixel that is not finite counts as black and leaves no trace; convex
filters stay in range; long sequences stay bounded; half precision is close or refused; cuts reset the history.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from datasets.channels import REFERENCE_CHANNELS
from datasets.clip import Dataset
from datasets.frame import Frame, read_frame
from datasets.tonemap import display, psnr
from errors import BadInput
from eval.bench.synthetic_frames import synthetic_frame
from eval.stress.check import ROUNDING, range_violation
from models import compiled, registry
from tests.helpers.denoisers import each
from tests.helpers.frames import chain, flat_frame, play, prepared, run

WRAPPED = ("noisy+taa", "noisy+accumulated", "wskp3+taa", "eaw+adaptive", "wskp3+adaptive", "eaw+js")
NAMES = [name for name in (*registry.DENOISERS, *WRAPPED) if not registry.prototype(name).unavailable()]
FILTERS = ("eaw", "svgf", "asvgf", "trmv", "bmfr", "aaf", "sbf")  # those without a network that run in real time
LIKE_OTHERS = ("wskp6", "wskp3+adaptive", "wskp3+taa")  # slow, as they share the code of others below
pytestmark = pytest.mark.usefixtures("one_thread")
ALL = tuple(registry.channels_read())


@pytest.fixture(scope="module")
def denoisers():
    return {name: prepared(name) for name in NAMES}


# --- Frames at the extremes -------------------------------------------------------------------------------------------

LEVELS = st.sampled_from([0.0, 1e-7, 1e-3, 1.0, 100.0, 6e4])
DEPTHS = st.sampled_from([0.0, 1e-4, 1.0, 1e6])
MOTIONS = st.sampled_from([(0.0, 0.0), (0.4, -0.7), (3.0, 0.0), (1e5, -1e5), (-1e30, 1e30)])


@st.composite
def frames_strategy(draw, longest=4, largest=19):
    """A sequence: any size, any level of light, fireflies, surfaces near and far or none, any motion."""
    height = draw(st.integers(1, largest))
    width = draw(st.integers(1, largest))
    depth = draw(DEPTHS)
    albedo = draw(st.sampled_from([0.0, 0.02, 0.5, 1.0]))
    roughness = draw(st.sampled_from([0.0, 1.0]))
    rng = np.random.default_rng(draw(st.integers(0, 2**31)))
    frames = []
    for _ in range(draw(st.integers(1, longest))):
        motion = draw(MOTIONS)
        light = draw(LEVELS) * rng.choice([0.0, 1.0, 10.0], (1, 3, height, width), p=[0.5, 0.4, 0.1])
        light = np.minimum(light, 65504)
        if draw(st.booleans()):
            light[..., rng.integers(height), rng.integers(width)] = 65504
        frame = flat_frame(height, width, motion if abs(motion[0]) < 1e4 else (0.0, 0.0), depth=max(depth, 1e-4))
        frame.channels.update(
            direct=torch.from_numpy(np.float32(light)),
            indirect=torch.from_numpy(np.float32(light[:, ::-1].copy())),
            albedo=torch.full((1, 3, height, width), albedo),
            roughness=torch.full((1, 1, height, width), roughness),
            gradient=torch.from_numpy(np.float32(light[:, :2] - light[:, 1:, ::-1])),  # the largest may be too small
        )
        if depth == 0:
            frame.channels.update(depth=torch.zeros(1, 1, height, width), mesh_id=torch.zeros(1, 1, height, width))
            frame.channels.update(normal=torch.zeros(1, 3, height, width))
        for name in ("motion", "dual_motion"):
            frame.channels[name] = torch.tensor(motion)[None, :, None, None].expand(1, 2, height, width).contiguous()
        frames.append(frame)
    return chain(frames)


# How many examples: see tests/conftest.py.
SETTINGS = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


@pytest.mark.parametrize("name", each(NAMES, *LIKE_OTHERS))
@SETTINGS
@given(frames=frames_strategy())
def test_finite_in_finite_out_and_nothing_below_zero(denoisers, name, frames):
    for frame, output in zip(frames, run(denoisers[name], frames), strict=True):
        assert output.shape == (1, 3, *frame.size) and output.dtype == torch.float32
        assert torch.isfinite(output).all()
        assert (output >= 0).all()


@pytest.mark.parametrize("name", each((name for name in NAMES if name != "noisy"), *LIKE_OTHERS))
@SETTINGS
@given(
    frames=frames_strategy(),
    poison=st.sampled_from([np.nan, np.inf, -np.inf]),
    channel=st.sampled_from(ALL),
    place=st.tuples(st.integers(0, 18), st.integers(0, 18)),
)
def test_a_poisoned_pixel_counts_as_zero(denoisers, name, frames, poison, channel, place):
    """So it can spread no further than an ordinary pixel, in its frame or through the state; in any channel."""
    y = place[0] % frames[0].size[0]
    x = place[1] % frames[0].size[1]

    def with_pixel(value):
        tensor = frames[0].channels[channel].clone()
        tensor[0, :, y, x] = value
        return [replace(frames[0], channels=frames[0].channels | {channel: tensor}), *frames[1:]]

    poisoned, black = (run(denoisers[name], with_pixel(value)) for value in (poison, 0.0))
    assert all(torch.isfinite(output).all() for output in black)
    torch.testing.assert_close(poisoned, black, rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", each((name for name in NAMES if registry.prototype(name).convex), *LIKE_OTHERS))
@SETTINGS
@given(frames=frames_strategy())
def test_convex_filters_stay_in_range(denoisers, name, frames):
    assert range_violation(denoisers[name], frames, run(denoisers[name], frames)) <= ROUNDING


# --- Long sequences ---------------------------------------------------------------------------------------------------


def noisy_sequence(count: int, size: int = 8):
    """Frames of unit irradiance under 1-spp noise, with now and then a firefly, a black frame and a jolt."""
    rng = np.random.default_rng(0)
    for index in range(count):
        light = 4.0 * (rng.random((1, 1, size, size)) < 0.25) * np.ones((1, 3, 1, 1))
        if index % 37 == 5:
            light[..., 3, 4] = 65504
        if index % 101 == 7:
            light[:] = 0
        yield flat_frame(size, size, irradiance=torch.from_numpy(np.float32(light)))


@pytest.mark.parametrize("count", [50, pytest.param(10_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", each(NAMES, *LIKE_OTHERS))
def test_long_sequences_stay_bounded(denoisers, name, count):
    """Offline denoisers, which have no history, get a tenth."""
    outputs, state = play(denoisers[name], noisy_sequence(count // 10 if denoisers[name].offline else count))
    assert torch.isfinite(outputs[-1]).all() and outputs[-1].max() <= 65504 * 2
    for picture in state.pictures().values():
        assert torch.isfinite(picture).all()


# --- Precision --------------------------------------------------------------------------------------------------------


def shown_psnr(images, others, exposure) -> float:
    shown = [[display(image.double().numpy(), exposure) for image in sequence] for sequence in (images, others)]
    return psnr(float(np.mean(np.square(np.subtract(*shown)))))


@pytest.mark.parametrize("precision", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("name", each(NAMES, "rae", "ntd", *LIKE_OTHERS))
def test_half_precision_is_close_on_real_frames_or_refused_with_a_reason(tiny, name, precision):
    half = registry.create(name)
    if precision in half.refuses:
        with pytest.raises(BadInput, match=re.escape(half.refuses[precision])):
            half.prepare(precision)
        return
    torch.manual_seed(0)
    full = registry.create(name)
    half.load_state_dict(full.state_dict())
    full.prepare()
    half.prepare(precision)
    clip = Dataset(tiny).clips("test")[1]
    frames = [read_frame(clip, index, (*full.reads, *REFERENCE_CHANNELS)) for index in range(clip.frames)]
    truth = [frame.remodulate(frame.reference_irradiance(full.signal), full.signal) for frame in frames]
    exact = run(full, frames)
    rounded = run(half, frames)
    assert abs(shown_psnr(rounded, truth, clip.exposure) - shown_psnr(exact, truth, clip.exposure)) < 0.1
    assert shown_psnr(exact, rounded, clip.exposure) > 35


# --- Cuts -------------------------------------------------------------------------------------------------------------


def sequence(clip, start: int, count: int) -> list[Frame]:
    window = (slice(16, 48), slice(12, 52))
    return [read_frame(clip, index, ALL, window=window) for index in range(start, start + count)]


@pytest.mark.parametrize("name", each(NAMES, *LIKE_OTHERS))
def test_a_scene_cut_resets_the_history(tiny, denoisers, name):
    """Frames of another place in the middle of a sequence come out as if they were the first."""
    here, there = Dataset(tiny).clips("test")[:2]
    before, length = (1, 1) if denoisers[name].offline else (4, 3)
    after = sequence(there, 4, length)
    cut = run(denoisers[name], sequence(here, 0, before) + after)[before:]
    torch.testing.assert_close(cut, run(denoisers[name], after), rtol=0, atol=0)


@pytest.mark.parametrize("name", each(NAMES, *LIKE_OTHERS))
def test_preparing_twice_changes_nothing(name):
    denoiser = prepared(name)
    frame = flat_frame(9, 7)
    once = run(denoiser, [frame])[0]
    denoiser.prepare()
    assert torch.equal(run(denoiser, [frame])[0], once)


# --- Scale ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["accumulated", *FILTERS, "rae", "ntd", "lbf", "one", "noisy+taa", "accumulated+adaptive"]
)
def test_a_thousand_times_the_light_is_a_thousand_times_the_output(name):
    denoiser = prepared(name)
    frames = [synthetic_frame(index, 30, 40) for index in range(4)]
    bright = [
        frame.with_channels({light: 1000 * frame.channel(light) for light in ("direct", "indirect", "emission")})
        for frame in frames
    ]
    expected = [1000 * output for output in run(denoiser, frames)]
    torch.testing.assert_close(run(denoiser, bright), expected, rtol=1e-3, atol=1e-3)


# --- Kernels ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["accumulated", *FILTERS])
@pytest.mark.parametrize("signal", ["total", pytest.param("indirect", marks=pytest.mark.slow)])
def test_kernels_and_pytorch_agree(name, signal):
    frames = [synthetic_frame(index, 41, 70) for index in range(4)]
    denoiser = registry.create(name, signal)
    fast = run(denoiser, frames)
    with compiled.disabled():
        slow = run(denoiser, frames)
    torch.testing.assert_close(fast, slow, rtol=2e-4, atol=1e-5)
