"""A history that follows the light: by how much, from when on, and what stays as it is."""

import pytest
import torch
from torch import Tensor

from models import compiled
from models.history.coarse_light import COARSE_DEVIATIONS
from models.history.light_gain import (
    GAIN_DEVIATION,
    GAUSSIAN_REACH,
    MAX_GAIN,
    TILE,
    at_pixels,
    follow_light,
    gain_of,
    tile_sums,
)
from tests.helpers.frames import chain, flat_frame, play
from tests.models.test_one import silent

SIZE = (72, 120)  # px: half a tile is beyond the borders

pytestmark = pytest.mark.usefixtures("implementation")


def exponential(mean: Tensor, seed: int = 0) -> Tensor:
    """Grey light of that mean (B, 3, H, W) as noisy as one sample often is: its standard deviation is the mean."""
    generator = torch.Generator().manual_seed(seed)
    return mean * torch.empty_like(mean[:, :1]).exponential_(generator=generator)


def even(value: float) -> Tensor:
    return torch.full((1, 3, *SIZE), float(value))


def gain(history: Tensor, noisy: Tensor, has_history: Tensor | None = None) -> Tensor:
    mask = torch.ones_like(noisy[:, :1]) if has_history is None else has_history
    return at_pixels(gain_of(tile_sums(history, noisy, mask)), *noisy.shape[-2:])


@pytest.mark.parametrize("ratio", [0.5, 1.5, 3.0])
def test_light_that_changes_everywhere(ratio):
    torch.testing.assert_close(gain(even(2), even(2 * ratio)), even(ratio)[:, :1], rtol=0.02, atol=0)
    noisy = gain(even(2), exponential(even(2 * ratio)))
    assert (noisy / ratio).log().abs().max() < 0.15


def test_noise_alone_is_no_change():
    """Of a normal distribution 0.3 % lie beyond three standard errors; that of these sums is a little skew."""
    past = torch.ones(16, 3, 512, 512)
    changed = gain_of(tile_sums(past, exponential(past), past[:, :1])) != 1
    assert changed.float().mean() < 0.01


@pytest.mark.parametrize("value", [1e3, 1e30])
def test_a_firefly_is_no_change(value):
    noisy = even(2)
    noisy[..., 30, 40] = value
    assert (gain(even(2), noisy) == 1).all()


@pytest.mark.parametrize("history, noisy", [(0.0, 1.0), (1.0, 1e30), (1e30, 0.0), (1e-30, 1e30), (0.0, 0.0)])
def test_a_gain_is_bounded(history, noisy):
    result = gain(even(history), even(noisy))
    assert torch.isfinite(result).all()
    assert result.min() >= 1 / MAX_GAIN and result.max() <= MAX_GAIN


def test_pixels_without_history_do_not_count():
    known = (torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(3)) < 0.5).float()
    history, noisy = even(2) * known, exponential(even(3))
    hidden = torch.where(known > 0, noisy, 1e6)
    torch.testing.assert_close(gain(history, hidden, known), gain(history, noisy, known), rtol=0, atol=0)
    assert (gain(history, noisy, torch.zeros_like(known)) == 1).all()


def test_a_highlight_that_slides_is_followed():
    """By 8 px: most of the difference is gone, and what is far away stays as it is."""
    x = torch.arange(400.0).expand(1, 3, 300, 400)
    y = torch.arange(300.0)[:, None].expand(1, 3, 300, 400)
    before, now = (1 + 4 * torch.exp(-((x - at) ** 2 + (y - 150) ** 2) / (2 * 60.0**2)) for at in (150, 158))
    factor = gain(before, exponential(now))
    error, lag = ((each - now).abs().mean() for each in (before * factor, before))
    assert error < 0.6 * lag
    assert (factor[..., 380:] - 1).abs().max() < 0.02


def test_only_light_is_multiplied():
    history, noisy = torch.rand(1, 13, *SIZE), exponential(even(3))
    known = torch.ones(1, 1, *SIZE)
    expected = gain(history, noisy)
    followed = follow_light(history.clone(), noisy, known, 6)
    torch.testing.assert_close(followed[:, 6:], history[:, 6:], rtol=0, atol=0)
    torch.testing.assert_close(followed[:, :6], history[:, :6] * expected)


@pytest.mark.parametrize("deviation", [GAIN_DEVIATION, *COARSE_DEVIATIONS])
def test_the_squared_standard_error_of_a_gaussian_sum(deviation):
    """Of values with variance 1: the sum of squared weights is half of the sum of weights, here and in the limit."""
    radius = GAUSSIAN_REACH * deviation
    offsets = torch.arange(-radius, radius + 1, dtype=torch.float64)
    weights = torch.exp(-offsets.square() / (2 * deviation**2))
    weights = weights[:, None] * weights
    assert abs(weights.square().sum() / weights.sum() - 0.5) < 0.002


@pytest.mark.parametrize("size", [(1, 1), (5, 17), (33, 70)])
def test_kernels_are_pytorch_at_any_size(size):
    generator = torch.Generator().manual_seed(1)
    history, noisy = (torch.rand(2, count, *size, generator=generator) for count in (13, 3))
    known = (torch.rand(2, 1, *size, generator=generator) < 0.8).float()
    noisy = 2 * noisy
    fast = follow_light(history.clone(), noisy, known, 6)
    with compiled.disabled():
        slow = follow_light(history, noisy, known, 6)
    torch.testing.assert_close(fast, slow)


def test_the_accumulation_of_one_follows_light_that_doubles():
    """A network that says nothing averages all samples: without a gain, 16 dark ones and a bright one."""
    images = [exponential(even(0.5 if i < 16 else 1), i) for i in range(17)]
    _, state = play(silent(), chain([flat_frame(*SIZE, irradiance=image) for image in images]))
    mean = state.accumulated[..., TILE:-TILE, TILE:-TILE].mean()
    assert abs(mean - 1) < 0.04
    assert (state.length.mean() - 17).abs() < 0.5  # and stays as free of noise
