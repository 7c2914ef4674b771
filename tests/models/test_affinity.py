"""The affinity filter of models.networks.one: means, edges and gradients, by kernels and by PyTorch."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from models import compiled
from models.compiled.affinity import MESH_DISTANCE
from models.networks.one import affinity_level
from tests.helpers.windows import Pixel, window

CHANNELS = 4
FEATURES = 8


def random_inputs(seed: int, height: int, width: int, background: float = 0.2) -> list[Tensor]:
    """image, features, sharpness, own, importance, surface, mesh_id."""
    generator = torch.Generator().manual_seed(seed)

    def normal(channels: int) -> Tensor:
        return torch.randn(2, channels, height, width, generator=generator)

    surface = (torch.rand(2, 1, height, width, generator=generator) >= background).float()
    mesh_id = torch.randint(1, 4, surface.shape, generator=generator).float()
    maps = [normal(FEATURES), 2 * normal(1).abs(), normal(1), normal(1)]
    return [5 * normal(CHANNELS).abs(), *maps, surface, mesh_id]


def random_guide(seed: int, height: int, width: int) -> Tensor:
    """Values and their strength."""
    return torch.randn(2, 2, height, width, generator=torch.Generator().manual_seed(seed + 3)).abs()


def by_definition(inputs: list[Tensor], guide: Tensor | None, item: int, p: Pixel, step: int) -> Tensor:
    """The filtered pixel, tap by tap in float64."""
    image, features, sharpness, own, importance, surface, mesh_id = (tensor[item].double() for tensor in inputs)
    total = torch.zeros(CHANNELS, dtype=torch.float64)
    weights = torch.zeros((), dtype=torch.float64)
    for q in window(surface.shape[1:], p, 1, step):
        distance = (features[:, *p] - features[:, *q]).square().sum()
        distance += MESH_DISTANCE * (mesh_id[0, *p] != mesh_id[0, *q])
        if guide is not None:
            distance += guide[item, 1, *p] * (guide[item, 0, *p] - guide[item, 0, *q]).square()
        exponent = (importance[0, *q] - sharpness[0, *p] * distance).clamp(min=-40)
        weight = torch.exp(own[0, *p] if q == p else exponent) * surface[0, *q]
        total += weight * image[:, *q]
        weights += weight
    return total / weights if surface[0, *p] > 0 else 0 * total


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize(("step", "guided"), [(1, False), (3, False), (2, True)])
def test_a_level_is_its_formula(step: int, guided: bool) -> None:
    inputs = random_inputs(0, 5, 7)
    guide = random_guide(0, 5, 7) if guided else None
    filtered = affinity_level(*inputs, step, guide)
    for item, *p in np.ndindex(2, 5, 7):
        expected = by_definition(inputs, guide, item, tuple(p), step)
        torch.testing.assert_close(filtered[item, :, *p].double(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.usefixtures("implementation")
@pytest.mark.parametrize("number", [0.0, 7.0, 16777215.0])
def test_another_mesh_is_as_far_as_other_features(number: float) -> None:
    """Where nothing else differs; with one mesh, of any number, features alone count."""
    image, features, *maps, surface, _ = random_inputs(4, 5, 7)
    left = (torch.arange(7) < 3).float().expand_as(surface)
    by_mesh = affinity_level(image, features, *maps, surface, number + left, 1)
    further = torch.cat([features, left * MESH_DISTANCE**0.5, torch.zeros_like(features[:, :3])], dim=1)
    one_mesh = torch.full_like(surface, number)
    torch.testing.assert_close(by_mesh, affinity_level(image, further, *maps, surface, one_mesh, 1))
    assert not torch.allclose(by_mesh, affinity_level(image, features, *maps, surface, one_mesh, 1))


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize(("height", "width", "step"), [(1, 1, 1), (1, 9, 2), (13, 20, 1), (13, 20, 8), (6, 300, 4)])
def test_kernels_have_the_gradients_of_pytorch(height: int, width: int, step: int, guided: bool) -> None:
    """Also of a guide's values."""
    inputs = random_inputs(1, height, width)
    values, strength = random_guide(1, height, width).split(1, dim=1)
    differentiable = [tensor.requires_grad_() for tensor in inputs[:5]] + [values.requires_grad_()] * guided
    arguments = [*inputs, step, torch.cat([values, strength], dim=1)] if guided else [*inputs, step]
    upstream = torch.randn(2, CHANNELS, height, width, generator=torch.Generator().manual_seed(2))
    filtered = affinity_level(*arguments)
    gradients = torch.autograd.grad(filtered, differentiable, upstream)
    with compiled.disabled():
        expected = affinity_level(*arguments)
        expected_gradients = torch.autograd.grad(expected, differentiable, upstream)
    torch.testing.assert_close(filtered, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(gradients, expected_gradients, rtol=1e-4, atol=1e-4)


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
    image, features, sharpness, own, importance, *others = random_inputs(seed, *size)
    image = image * scale
    logits = ((10 * torch.tanh(spread * tensor)) for tensor in (own, importance))
    filtered = affinity_level(image, spread * features, spread * sharpness, *logits, *others, 2)
    assert filtered.isfinite().all()
    assert (filtered >= 0).all()
    assert (filtered <= image.amax() * (1 + 1e-5)).all()
    assert (filtered[(others[0] == 0).expand_as(filtered)] == 0).all()
