"""Weight-shared kernel fusion against unfold and softmax in float64, at every extreme of the logits."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models import compiled
from models.compiled.fusion import WINDOWS
from models.networks.fusion import fuse
from tests.helpers.unfold import unfold_fuse


def both_ways(image, importance, mixture, surface=None):
    with torch.no_grad():
        fast = fuse(image, importance, mixture, WINDOWS, surface)
        with compiled.disabled():
            return fast, fuse(image, importance, mixture, WINDOWS, surface)


@settings(max_examples=40, deadline=None)
@given(
    height=st.integers(1, 70),
    width=st.integers(1, 23),
    scale=st.sampled_from([0.0, 1.0, 30.0, 100.0, 1e4]),
    shape=st.sampled_from(["noise", "ramp", "step", "spike"]),
    offset=st.sampled_from([0.0, 1e4, -1e4]),
    share=st.sampled_from([None, 0.0, 0.02, 0.5, 0.98]),
    seed=st.integers(0, 9999),
)
def test_fusion_is_exact_for_any_finite_logits(height, width, scale, shape, offset, share, seed):
    """With background as well, whatever its logits are."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width]
    patterns = {
        "noise": rng.uniform(-1, 1, (6, height, width)),
        "ramp": np.broadcast_to((x + y) / max(height + width, 2) * 2 - 1, (6, height, width)),
        "step": np.broadcast_to(np.where(x > width // 2, 1.0, -1.0), (6, height, width)),
        "spike": (rng.random((6, height, width)) < 0.02) * 2.0 - 1,
    }
    importance = torch.from_numpy(np.float32(patterns[shape] * scale + offset))[None]
    mixture = torch.from_numpy(np.float32(rng.normal(0, scale, (1, 6, height, width))))
    image = torch.from_numpy(np.float32(10 ** rng.uniform(-7, 6.8, (1, 3, height, width))))
    surface = None if share is None else torch.from_numpy(np.float32(rng.random((1, 1, height, width)) < share))
    if surface is not None:
        importance += 1e4 * (1 - surface) * (torch.from_numpy(rng.random((1, 1, height, width))) < 0.1)
    expected = unfold_fuse(image.double(), importance.double(), mixture.double(), surface=surface).numpy()
    for result in both_ways(image, importance, mixture, surface):
        # Where windows show no surface, what is left may have any share: atol is the rounding of the darkest pixel.
        np.testing.assert_allclose(result.numpy(), expected, rtol=2e-5, atol=2e-12)


def test_a_wide_range_in_one_corner_does_not_touch_the_rest():
    """Strips choose their path one by one: the boundary between the two must not be visible."""
    torch.manual_seed(1)
    importance = torch.randn(1, 6, 200, 40)
    mixture = torch.randn(1, 6, 200, 40)
    importance[..., 100, 3] = 5000
    image = torch.rand(1, 3, 200, 40)
    expected = unfold_fuse(image.double(), importance.double(), mixture.double())
    for result in both_ways(image, importance, mixture):
        torch.testing.assert_close(result.double(), expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("background", [False, True])
@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_gradients_equal_plain_autograd_of_the_naive_version(scale, background):
    """On the fast and on the careful path, also with windows that show no surface."""
    torch.manual_seed(2)
    surface = (torch.rand(2, 1, 17, 12) < 0.5).float() * (torch.arange(12) < 7) if background else None
    inputs = [torch.rand(2, 3, 17, 12), scale * torch.randn(2, 6, 17, 12), torch.randn(2, 6, 17, 12)]
    mine = [t.clone().requires_grad_() for t in inputs]
    exact = [t.double().requires_grad_() for t in inputs]
    target = torch.rand(2, 3, 17, 12)
    (fuse(*mine, surface=surface) * target).sum().backward()
    (unfold_fuse(*exact, surface=surface) * target.double()).sum().backward()
    for a, b in zip(mine, exact, strict=True):
        torch.testing.assert_close(a.grad.double(), b.grad, rtol=1e-4, atol=1e-5)
        assert torch.isfinite(a.grad).all()
