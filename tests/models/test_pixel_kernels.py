"""Per-pixel kernels against unfolding in float64 and against plain autograd, compiled and in PyTorch."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from models import compiled
from models.networks.pixel_kernels import apply_kernels
from tests.helpers.unfold import unfold_kernels


def inputs(size: int, height: int, width: int, spread: float = 3.0, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(2, 3, height, width, generator=generator) * 10
    return image, spread * torch.randn(2, size * size, height, width, generator=generator)


def both_ways(image: Tensor, logits: Tensor, surface: Tensor | None = None) -> tuple[Tensor, Tensor]:
    fast = apply_kernels(image, logits, surface)
    with compiled.disabled():
        return fast, apply_kernels(image, logits, surface)


def expected(image: Tensor, logits: Tensor, surface: Tensor | None = None) -> Tensor:
    return unfold_kernels(image.double(), logits.double(), surface)


@settings(max_examples=40, deadline=None)
@given(
    size=st.sampled_from([1, 3, 5, 13]),
    height=st.integers(1, 20),
    width=st.integers(1, 20),
    spread=st.sampled_from([0.0, 3.0, 1e4, 1e37]),
    share=st.sampled_from([None, 0.0, 0.02, 0.5, 0.98]),
    seed=st.integers(0, 99),
)
def test_equals_the_naive_version(size, height, width, spread, share, seed):
    """Also for images smaller than the window, for logits whose exponentials overflow, and beside background."""
    image, logits = inputs(size, height, width, spread, seed)
    image = image**6  # bright and dark
    generator = torch.Generator().manual_seed(seed + 1)
    surface = None if share is None else (torch.rand(2, 1, height, width, generator=generator) < share).float()
    for filtered in both_ways(image, logits, surface):
        assert filtered.dtype == torch.float32 and filtered.is_contiguous()
        torch.testing.assert_close(filtered.double(), expected(image, logits, surface), rtol=1e-5, atol=1e-30)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
@pytest.mark.parametrize("memory", [torch.contiguous_format, torch.channels_last])
def test_logits_as_a_network_leaves_them(dtype, memory):
    """Some channels of a larger tensor, in half precision, channels last: computed in float32 nevertheless."""
    image, _ = inputs(5, 9, 33)
    head = torch.randn(2, 51, 9, 33).to(dtype).contiguous(memory_format=memory)
    image = image.contiguous(memory_format=memory)
    for logits in (head[:, :25], head[:, 25:50]):
        for filtered in both_ways(image, logits):
            torch.testing.assert_close(filtered.double(), expected(image, logits), rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("dtype, spread", [(torch.float32, 3.0), (torch.float32, 1e4), (torch.bfloat16, 3.0)])
def test_gradients_equal_those_of_plain_autograd(dtype, spread, background):
    """Also with windows that show no surface."""
    image, logits = inputs(5, 6, 9, spread)
    logits = logits.to(dtype)
    generator = torch.Generator().manual_seed(1)
    weight = torch.randn(image.shape, generator=generator)
    surface = (torch.rand(2, 1, 6, 9, generator=generator) < 0.5) * (torch.arange(9) < 5.0) if background else None
    results = []
    for function in (apply_kernels, expected):
        x, y = (t.clone().requires_grad_() for t in (image, logits))
        (function(x, y, surface) * weight).sum().backward()
        assert y.grad.dtype == dtype
        results.append((x.grad, y.grad))
    torch.testing.assert_close(*(x for x, _ in results), rtol=1e-5, atol=1e-5)
    rough = 2**-7 if dtype == torch.bfloat16 else 1e-5
    torch.testing.assert_close(*(y for _, y in results), rtol=rough, atol=1e-5)


def test_training_keeps_no_window():
    """Saved for the backward pass: the inputs, the result, and two numbers a pixel."""
    image, logits = inputs(5, 32, 32)
    kept: list[int] = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t.numel()) or t, lambda t: t):
        apply_kernels(image, logits.requires_grad_())
    assert sum(kept) <= 2 * 32 * 32 * (25 + 3 + 3 + 2)
