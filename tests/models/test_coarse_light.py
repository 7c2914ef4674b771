"""Coarse corrections: what bias they remove, what they take for noise, and where they look for past residuals."""

import pytest
import torch
from torch import Tensor

from models.history.coarse_light import COARSE_LENGTH, COARSE_TILE, CoarseLight, correct_coarsely, fetched_tiles
from models.history.light_gain import MAX_GAIN
from tests.helpers.frames import chain, flat_frame, play
from tests.models.test_light_gain import exponential
from tests.models.test_one import silent

SIZE = (100, 132)  # px: half a tile is beyond the borders
STILL = torch.zeros(1, 2, *SIZE)
EVERYWHERE = torch.ones(1, 1, *SIZE)


def light(value: float) -> Tensor:
    return torch.full((1, 3, *SIZE), float(value))


def correct(noisy: Tensor, denoised: Tensor, before: CoarseLight | None = None, motion: Tensor = STILL) -> CoarseLight:
    exposure = torch.ones(1, 3, 1, 1)
    return correct_coarsely(noisy, denoised, exposure, EVERYWHERE, motion, before)


def corrected(noisy: Tensor, denoised: Tensor) -> Tensor:
    return correct(noisy, denoised).corrected(denoised)


@pytest.mark.parametrize("factor", [0.5, 0.9, 1.2, 2.0])
def test_a_bias_is_removed(factor):
    """Of light as noisy as one sample often is; what shrinkage leaves of small ones is within their noise."""
    truth = light(2)
    denoised = factor * truth
    error = (corrected(exponential(truth), denoised) / truth - 1).abs().mean()
    assert error < 0.06
    assert error < 0.8 * abs(factor - 1)


def test_noise_alone_changes_little():
    truth = light(2)
    errors = [(corrected(exponential(truth, seed), truth) / truth - 1).abs().mean() for seed in range(8)]
    assert sum(errors) / len(errors) < 0.02  # the mean of a narrow neighbourhood is uncertain by 0.035


def test_frames_are_averaged():
    """Of a bias of a fifth in a quarter of the image, less error is left when more frames are known."""
    truth = light(1)
    denoised = truth.clone()
    denoised[..., :50, :66] = 0.8
    errors = torch.zeros(6)
    for seed in range(6):
        state = None
        for frame in range(6):
            state = correct(exponential(truth, 10 * seed + frame), denoised, state)
            errors[frame] += (state.corrected(denoised) - truth).square().mean()
    assert errors[3] < 0.7 * errors[0]
    assert state.residual[:, 2].max() == COARSE_LENGTH


def test_bright_pixels_count_as_much_as_dark_ones():
    """A bright lamp that is right does not hide that the wall around it is wrong."""
    truth = light(1)
    truth[..., ::4, ::4] = 300
    denoised = torch.where(truth > 1, truth, 0.7)
    change = correct(truth, denoised).gain
    assert (change - 1 / 0.7).abs().max() < 0.06


def test_light_that_leaks_into_black_neighbourhoods_vanishes():
    truth = light(1)
    truth[..., SIZE[1] // 2 :] = 0
    change = correct(exponential(truth), truth + 1e-4).gain
    assert change[..., -2:].max() < 0.02 and change[..., :2].min() > 0.9


@pytest.mark.parametrize("value", [1e3, 1e30])
def test_a_firefly_is_no_bias(value):
    noisy = light(2)
    noisy[..., 30, 40] = value
    assert (correct(noisy, light(2)).gain == 1).all()


@pytest.mark.parametrize("noisy, denoised", [(0.0, 1.0), (1.0, 1e30), (1e30, 0.0), (1e-30, 1e30), (0.0, 0.0)])
def test_a_correction_is_bounded(noisy, denoised):
    state = None
    for _ in range(3):
        state = correct(light(noisy), light(denoised), state)
        assert torch.isfinite(state.residual).all()
        assert state.gain.min() >= 0 and state.gain.max() <= MAX_GAIN**2


def test_background_does_not_count():
    surface = (torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(3)) < 0.5).float()
    noisy, exposure = exponential(light(2)), torch.ones(1, 3, 1, 1)
    gains = [
        correct_coarsely(torch.where(surface > 0, noisy, other), light(1.5), exposure, surface, STILL, None).gain
        for other in (0.0, 1e6)
    ]
    torch.testing.assert_close(*gains, rtol=0, atol=0)


def test_residuals_move_with_surfaces():
    """A tile's own place, three tiles to the right and half a tile down, and outside the image."""
    tiles = torch.arange(12.0 * 16).view(1, 1, 12, 16)
    for x, y, shift in ((0, 0, 0), (24, 0, 3), (0, 4, 8)):
        motion = torch.tensor([x, y]).view(1, 2, 1, 1).expand(1, 2, 12, 16).float()
        past, inside = fetched_tiles(tiles, motion, (12, 16))
        assert torch.equal(past[..., :8, :12], tiles[..., :8, :12] + shift)
        assert inside[..., : 12 - 1, : 16 - x // COARSE_TILE].all()
    for far in (1e35, -200.0):
        past, inside = fetched_tiles(tiles, torch.full((1, 2, 12, 16), far), (12, 16))
        assert not inside.any() and torch.isfinite(past).all()


def test_the_history_of_one_stays_uncorrected():
    """A network that says nothing averages: what it carries is the mean, what it returns is corrected."""
    images = [exponential(light(1), i) for i in range(3)]
    outputs, state = play(silent(), chain([flat_frame(*SIZE, irradiance=image) for image in images]))
    torch.testing.assert_close(outputs[-1], state.coarse.corrected(state.output))
    assert (state.coarse.gain != 1).any()
