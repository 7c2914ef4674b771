"""NBGD: bilateral grids against slow versions, their gradients, and how three of them are mixed."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from models import compiled, registry
from models.networks.nbgd import SPACINGS, grid_mean, grid_shape

PLACE_ROUNDING = 10 * 2.0**-18  # of values up to 10, by that of float32 places among up to 64 cells


def random_inputs(seed: int, height: int, width: int, share: float = 0.7) -> tuple[Tensor, Tensor, Tensor]:
    """Two images of bright light, guides and surfaces."""
    generator = torch.Generator().manual_seed(seed)
    image = 10 * torch.rand(2, 3, height, width, generator=generator) ** 4
    guide = torch.rand(2, 1, height, width, generator=generator)
    guide[0, 0, 0, 0] = 0
    guide[1, 0, -1, -1] = 1
    surface = (torch.rand(2, 1, height, width, generator=generator) < share).float()
    return image, guide, surface


def tent(distance):
    return np.maximum(1 - np.abs(distance), 0)


def by_definition(image, guide, surface, spacing: int):
    """image (3, H, W): all pixels against all cells, in float64."""
    height, width = guide.shape
    y, x = np.indices(guide.shape)
    pixels = np.stack([y, x, 255 * guide], axis=-1).reshape(-1, 3) + 0.5
    counts = (-(-height // spacing), -(-width // spacing), 256 // spacing)
    cells = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3) + 0.5
    weights = np.ones((len(pixels), len(cells)))
    for axis in range(3):
        weights *= tent(pixels[:, [axis]] / spacing - cells[:, axis])
    values = image.reshape(3, -1).T
    counted = surface.reshape(-1, 1) > 0
    totals = (weights * counted).sum(axis=0)
    used = totals > 0
    means = (weights * counted).T[used] @ values / totals[used, None]
    sliced = weights[:, used] @ means / np.maximum(weights[:, used].sum(axis=1, keepdims=True), 1e-300)
    return (sliced * counted).T.reshape(image.shape)


@pytest.mark.usefixtures("implementation")
@settings(deadline=None)
@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 20)),
    spacing=st.sampled_from(SPACINGS),
    share=st.sampled_from([0.0, 0.1, 0.9]),
    seed=st.integers(0, 999),
)
def test_splat_and_slice_are_the_definition(size, spacing, share, seed):
    image, guide, surface = random_inputs(seed, *size, share)
    filtered = grid_mean(image, guide, spacing, surface)
    arrays = (tensor.double().numpy() for tensor in (image, guide[:, 0], surface[:, 0]))
    for item, inputs in enumerate(zip(*arrays, strict=True)):
        np.testing.assert_allclose(filtered[item], by_definition(*inputs, spacing), rtol=1e-4, atol=PLACE_ROUNDING)


@pytest.mark.parametrize("spacing", SPACINGS)
def test_the_kernel_equals_pytorch_in_many_strips(spacing):
    image, guide, _ = random_inputs(0, 203, 31)
    fast = grid_mean(image, guide, spacing)
    with compiled.disabled():
        torch.testing.assert_close(fast, grid_mean(image, guide, spacing), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("spacing", [4, pytest.param(16, marks=pytest.mark.slow)])
def test_gradients_are_those_of_finite_differences(spacing):
    image, guide, surface = (tensor.double() for tensor in random_inputs(1, 5, 6))
    image.requires_grad_()
    guide = (0.123 + 0.8 * guide).requires_grad_()  # none in the middle of a cell, where weights bend
    assert torch.autograd.gradcheck(lambda i, g: grid_mean(i, g, spacing, surface), (image, guide))


def test_the_kernel_reads_its_own_memory_alone():
    image, _, _ = random_inputs(4, 9, 9)
    for value in (torch.nan, torch.inf, -1e30, 1e30):
        assert torch.isfinite(grid_mean(image, torch.full((2, 1, 9, 9), value), 4)).all()


def test_grids_have_the_sizes_of_the_paper():
    """WSKP, Fig. 6: 320 x 180 x 64 to 80 x 45 x 16."""
    guide = torch.zeros(1, 1, 720, 1280)
    shapes = [grid_shape(guide, spacing) for spacing in SPACINGS]
    assert shapes == [(1, 180, 320, 64), (1, 90, 160, 32), (1, 45, 80, 16)]


def test_the_network_has_two_layers():
    """5 x 5, from 10 inputs over 20 channels to three guides and two weights."""
    denoiser = registry.create("nbgd")
    assert denoiser.parameter_count() == 10 * 20 * 25 + 20 + 20 * 5 * 25 + 5
    x = torch.rand(1, 10, 9, 8)
    with torch.no_grad():
        first, second = (layer for layer in denoiser.network if isinstance(layer, torch.nn.Conv2d))
        hidden = first(x)
        torch.testing.assert_close(denoiser.network(x), second(torch.where(hidden > 0, hidden, 0.2 * hidden)))


@pytest.mark.parametrize("shares", [(0.3, 0.5), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (0.9, 0.8)])
def test_the_third_picture_has_what_weights_leave(shares):
    """Which may be less than nothing: the result is cut off at 0."""
    image, _, surface = (tensor[:1] for tensor in random_inputs(5, 13, 22))
    guides = torch.randn(1, 3, 13, 22, generator=torch.Generator().manual_seed(0))
    logits = torch.logit(torch.tensor(shares), eps=1e-9).view(1, 2, 1, 1).expand(1, 2, 13, 22)
    output, mixture = registry.create("nbgd").reconstruct(image, torch.cat([guides, logits], dim=1), surface)
    guides = torch.sigmoid(guides)
    pictures = [grid_mean(image, guides[:, [i]], spacing, surface) for i, spacing in enumerate((4, 8, 16))]
    weights = (*shares, 1 - sum(shares))
    expected = sum(weight * picture for weight, picture in zip(weights, pictures, strict=True))
    assert mixture is None and output.min() >= 0
    torch.testing.assert_close(output, expected.clamp(min=0), rtol=1e-4, atol=1e-4)
