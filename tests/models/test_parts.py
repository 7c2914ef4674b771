"""Parts of the light that `one` denoises beside the whole: they add up to it, each has its own history."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from datasets.frame import Frame, read_frame
from models.networks.one import One
from tests.helpers.frames import prepared


def in_parts(frame: Frame, seed: int) -> Frame:
    """The frame with three parts that add up to its reflected light: one of either sign, and some of it."""
    light = frame.direct + frame.indirect
    share = torch.rand(light.shape, generator=torch.Generator().manual_seed(seed))
    parts = [1.5 * share * light, light - share * light, -0.5 * share * light]
    return replace(frame, parts=torch.cat(parts, dim=1))


def played(denoiser: One, frames: list[Frame]) -> list[tuple[Tensor, Tensor]]:
    """The denoised whole, without emission, and the parts (B, 3, 3, H, W) of each frame."""
    images = []
    state = None
    with torch.inference_mode():
        for frame in frames:
            output, state = denoiser(frame, state)
            images.append((output - frame.emission, denoiser.parts(frame, state).unflatten(1, (-1, 3))))
    return images


@pytest.fixture
def denoiser() -> One:
    made = prepared("one")
    assert isinstance(made, One)
    return made


@pytest.fixture(scope="module")
def frames(moving_clip) -> list[Frame]:
    return [read_frame(moving_clip, index, One.reads) for index in range(5)]


@pytest.mark.usefixtures("implementation")
def test_parts_add_up_and_the_whole_is_what_it_is_without_them(denoiser, frames):
    images = played(denoiser, [in_parts(frame, seed) for seed, frame in enumerate(frames)])
    state = None
    for (whole, parts), frame in zip(images, frames, strict=True):
        alone, state = denoiser(frame, state)
        torch.testing.assert_close(whole, (alone - frame.emission).detach(), rtol=1e-5, atol=1e-6)
        torch.testing.assert_close(parts.sum(dim=1), whole, rtol=1e-5, atol=1e-5 * float(whole.max()))
    assert parts[:, 2].max() <= 0 < parts[:, 0].max()  # kernels are convex: no part changes its sign


def test_a_part_that_is_all_of_the_light_is_the_whole_and_a_constant_stays_one(denoiser, frames):
    given = [replace(f, parts=torch.cat([f.direct + f.indirect, 0.25 * f.divisor], dim=1), masks=1) for f in frames]
    for (whole, parts), frame in zip(played(denoiser, given), given, strict=True):
        torch.testing.assert_close(parts[:, 0], torch.where(frame.depth > 0, whole, parts[:, 0]), rtol=1e-5, atol=1e-6)
        constant = torch.where(frame.depth > 0, parts[:, 1] / frame.divisor, 0.25)
        torch.testing.assert_close(constant, torch.full_like(constant, 0.25))


def test_light_beyond_what_is_filtered_is_cut_from_all_parts(denoiser, frames):
    extreme = [f.with_channels({"direct": f.direct.clone()}) for f in frames[:2]]
    for frame in extreme:
        frame.direct[..., 20, 30] = 1e30
        frame.direct[..., 21, 30] = -1.0
    for whole, parts in played(denoiser, [in_parts(frame.finite(), 1) for frame in extreme]):
        assert torch.isfinite(parts).all()
        torch.testing.assert_close(parts.sum(dim=1), whole, rtol=1e-5, atol=1e-5 * float(whole.max()))


def test_history_begins_anew_with_other_parts(denoiser, frames):
    with torch.inference_mode():
        _, state = denoiser(frames[0], None)
        after, state = denoiser(in_parts(frames[1], 0), state)
        anew, _ = denoiser(in_parts(frames[1], 0), None)
    assert torch.equal(after, anew)
