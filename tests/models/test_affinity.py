"""The affinity filter of models.networks.one: means, edges and gradients, by kernels and by PyTorch."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from models import compiled
from models.networks.one import affinity_level

FEATURES = 8


def random_inputs(seed: int, height: int, width: int, background: float = 0.2) -> list[Tensor]:
    """image, features, sharpness, own, importance, surface."""
    generator = torch.Generator().manual_seed(seed)

    def normal(channels: int) -> Tensor:
        return torch.randn(2, channels, height, width, generator=generator)

    surface = (torch.rand(2, 1, height, width, generator=generator) >= background).float()
    return [5 * normal(3).abs(), normal(FEATURES), 2 * normal(1).abs(), normal(1), normal(1), surface]


def by_definition(inputs: list[Tensor], item: int, y: int, x: int, step: int) -> Tensor:
    """The filtered pixel, tap by tap in float64."""
    image, features, sharpness, own, importance, surface = (tensor[item].double() for tensor in inputs)
    height, width = surface.shape[1:]
    total = torch.zeros(3, dtype=torch.float64)
    weights = torch.zeros((), dtype=torch.float64)
    for dy in (-step, 0, step):
        for dx in (-step, 0, step):
            if not (0 <= y + dy < height and 0 <= x + dx < width) or surface[0, y + dy, x + dx] == 0:
                continue
            distance = (features[:, y, x] - features[:, y + dy, x + dx]).square().sum()
            exponent = (importance[0, y + dy, x + dx] - sharpness[0, y, x] * distance).clamp(min=-40)
            weight = torch.exp(own[0, y, x] if dx == dy == 0 else exponent)
            total += weight * image[:, y + dy, x + dx]
            weights += weight
    return total / weights if surface[0, y, x] > 0 else torch.zeros(3, dtype=torch.float64)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("step", [1, 3])
def test_a_level_is_its_formula(step: int) -> None:
    inputs = random_inputs(0, 5, 7)
    filtered = affinity_level(*inputs, step)
    for item, y, x in ((0, 0, 0), (0, 2, 3), (1, 4, 6), (1, 1, 5), (0, 3, 0)):
        torch.testing.assert_close(
            filtered[item, :, y, x].double(), by_definition(inputs, item, y, x, step), rtol=1e-5, atol=1e-6
        )


@pytest.mark.parametrize(("height", "width", "step"), [(1, 1, 1), (1, 9, 2), (13, 20, 1), (13, 20, 8), (6, 300, 4)])
def test_kernels_have_the_gradients_of_pytorch(height: int, width: int, step: int) -> None:
    inputs = random_inputs(1, height, width)
    differentiable = [tensor.requires_grad_() for tensor in inputs[:5]]
    upstream = torch.randn(2, 3, height, width, generator=torch.Generator().manual_seed(2))
    filtered = affinity_level(*inputs, step)
    gradients = torch.autograd.grad(filtered, differentiable, upstream)
    with compiled.disabled():
        expected = affinity_level(*inputs, step)
        expected_gradients = torch.autograd.grad(expected, differentiable, upstream)
    torch.testing.assert_close(filtered, expected, rtol=1e-5, atol=1e-6)
    for gradient, other in zip(gradients, expected_gradients, strict=True):
        torch.testing.assert_close(gradient, other, rtol=1e-4, atol=1e-4)


def test_different_features_stop_the_filter_and_equal_ones_do_not() -> None:
    image = torch.zeros(1, 3, 4, 8)
    image[..., 4:] = 1
    ones = torch.ones(1, 1, 4, 8)
    features = image[:, :1].repeat(1, FEATURES, 1, 1)
    apart = affinity_level(image, features, 100 * ones, 0 * ones, 0 * ones, ones, 1)
    torch.testing.assert_close(apart, image)
    together = affinity_level(image, 0 * features, 100 * ones, 0 * ones, 0 * ones, ones, 1)
    torch.testing.assert_close(together[0, 0, 1], torch.tensor([0, 0, 0, 1 / 3, 2 / 3, 1, 1, 1]))


@settings(deadline=None)
@given(
    seed=st.integers(0, 99),
    scale=st.sampled_from([1e-7, 1.0, 6e4, 1e30]),
    spread=st.sampled_from([0.0, 1.0, 1e4]),
    size=st.sampled_from([(1, 1), (1, 17), (5, 3), (16, 33)]),
)
def test_stays_within_its_neighbourhood_whatever_the_weights(
    seed: int, scale: float, spread: float, size: tuple[int, int]
) -> None:
    image, features, sharpness, own, importance, surface = random_inputs(seed, *size)
    image = image * scale
    logits = ((10 * torch.tanh(spread * tensor)) for tensor in (own, importance))
    filtered = affinity_level(image, spread * features, spread * sharpness, *logits, surface, 2)
    assert filtered.isfinite().all()
    assert (filtered >= 0).all()
    assert (filtered <= image.amax() * (1 + 1e-5)).all()
    assert (filtered[(surface == 0).expand_as(filtered)] == 0).all()
