"""Per-pixel kernels against unfolding in float64 and against plain autograd, compiled and in PyTorch."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from models import compiled
from models.networks.pixel_kernels import ApplyKernels, apply_kernels


def naive(image: Tensor, logits: Tensor) -> Tensor:
    """All windows written out in float64, softmax over the taps inside the image."""
    image = image.double()
    logits = logits.double()
    batch, channels, height, width = image.shape
    taps = logits.shape[1]
    size = round(taps**0.5)
    windows = F.unfold(image, size, padding=size // 2).view(batch, channels, taps, height, width)
    inside = F.unfold(torch.ones_like(image[:, :1]), size, padding=size // 2).view(batch, taps, height, width)
    weights = torch.softmax(torch.where(inside > 0, logits, -torch.inf), dim=1)
    return (windows * weights[:, None]).sum(dim=2)


def inputs(size: int, height: int, width: int, spread: float = 3.0, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(2, 3, height, width, generator=generator) * 10
    return image, spread * torch.randn(2, size * size, height, width, generator=generator)


def both_ways(image: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
    fast = apply_kernels(image, logits)
    with compiled.disabled():
        return fast, apply_kernels(image, logits)


@settings(max_examples=40, deadline=None)
@given(
    size=st.sampled_from([1, 3, 5, 13]),
    height=st.integers(1, 20),
    width=st.integers(1, 20),
    spread=st.sampled_from([0.0, 3.0, 1e4, 1e37]),
    seed=st.integers(0, 99),
)
def test_equals_the_naive_version(size, height, width, spread, seed):
    """Also for images smaller than the window, and logits whose exponentials overflow."""
    image, logits = inputs(size, height, width, spread, seed)
    for filtered in both_ways(image, logits):
        assert filtered.dtype == torch.float32 and filtered.is_contiguous()
        torch.testing.assert_close(filtered.double(), naive(image, logits), rtol=3e-6, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("memory", [torch.contiguous_format, torch.channels_last])
def test_logits_as_a_network_leaves_them(dtype, memory):
    """Some channels of a larger tensor, in half precision, channels last: computed in float32 nevertheless."""
    image, _ = inputs(5, 9, 33)
    head = torch.randn(2, 51, 9, 33).to(dtype).contiguous(memory_format=memory)
    image = image.contiguous(memory_format=memory)
    for logits in (head[:, :25], head[:, 25:50]):
        for filtered in both_ways(image, logits):
            torch.testing.assert_close(filtered.double(), naive(image, logits), rtol=2e-6, atol=2e-6)


def test_one_tap_picks_its_pixel():
    """Taps are counted row by row from the top left; those outside the image have no weight."""
    image = torch.arange(12.0).view(1, 1, 3, 4)
    logits = torch.zeros(1, 9, 3, 4)
    logits[:, 2] = 1e4  # up and to the right
    for filtered in both_ways(image, logits):
        assert torch.equal(filtered[0, 0, 1:, :3], image[0, 0, :2, 1:])
        assert filtered[0, 0, 0, 0] == pytest.approx((0 + 1 + 4 + 5) / 4)


def test_the_output_is_within_the_range_of_the_window():
    image = torch.full((1, 3, 8, 40), 1e-7)
    image[..., 4, 20] = 65504 / 0.01
    for filtered in both_ways(image, 100 * torch.randn(1, 25, 8, 40)):
        assert filtered.min() >= 1e-7 * (1 - 1e-6) and filtered.max() <= image.max() * (1 + 1e-6)
        assert filtered[..., :2, :].max() <= 1.01e-7  # out of the firefly's reach


def test_gradients():
    image, logits = inputs(3, 4, 5)
    image, logits = (x.double().requires_grad_() for x in (image, logits))
    assert torch.autograd.gradcheck(ApplyKernels.apply, (image, logits))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_gradients_equal_those_of_plain_autograd(dtype):
    image, logits = inputs(5, 6, 4)
    logits = logits.to(dtype)
    weight = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
    results = []
    for function in (apply_kernels, naive):
        x, y = (t.clone().requires_grad_() for t in (image, logits))
        (function(x, y) * weight).sum().backward()
        assert y.grad.dtype == dtype
        results.append((x.grad, y.grad))
    torch.testing.assert_close(*(x for x, _ in results), rtol=1e-5, atol=1e-5)
    rough = 2**-7 if dtype == torch.bfloat16 else 1e-5
    torch.testing.assert_close(*(y for _, y in results), rtol=rough, atol=1e-5)


def test_gradients_of_extreme_logits_are_finite():
    image, logits = inputs(5, 6, 4, spread=1e4)
    image = image.requires_grad_()
    logits = logits.requires_grad_()
    apply_kernels(image, logits).sum().backward()
    assert torch.isfinite(image.grad).all() and torch.isfinite(logits.grad).all()


def test_training_keeps_no_window():
    """Saved for the backward pass: the inputs, the result, and two numbers a pixel."""
    image, logits = inputs(5, 32, 32)
    kept: list[int] = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t.numel()) or t, lambda t: t):
        apply_kernels(image, logits.requires_grad_())
    assert sum(kept) <= 2 * 32 * 32 * (25 + 3 + 3 + 2)
