"""The error estimate: unbiased where the truth is known, and finite at the extremes."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from errors import BadInput
from models.denoiser import Denoiser, State
from models.wrappers.error_estimate import ErrorEstimate, denoise_with_error, estimate_error
from models.wrappers.shrinkage import JamesStein
from tests.helpers.buffers import noisy_buffers, with_buffers
from tests.helpers.frames import flat_frame

SIZE = (256, 256)
SHAPES = (1, 3, *SIZE)


class Blur(Denoiser):
    """Means over 5 x 5 pixels: biased where the truth is curved, and correlated with the noise of the pixel itself."""

    reads = ("direct", "indirect", "emission", "albedo", "depth")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        blurred = F.avg_pool2d(frame.irradiance(self.signal), 5, 1, 2, count_include_pad=False)
        return frame.remodulate(blurred, self.signal), State(frame.moment)


def waves(length: float) -> Tensor:
    """Irradiance (1, 3, H, W) that oscillates by a half, with this wavelength in pixels."""
    x = torch.arange(SIZE[1]) * (2 * torch.pi / length)
    return (1 + torch.sin(x) / 2).expand(SHAPES).clone()


def denoised(truth: Tensor, deviation: float) -> tuple[Tensor, ErrorEstimate]:
    a, b = noisy_buffers(truth, deviation)
    output, _, estimate = denoise_with_error(JamesStein(Blur()), with_buffers(a, b), None)
    return output, estimate


@pytest.mark.parametrize("length", [8.0, 30.0, 1e6])
@pytest.mark.parametrize("deviation", [0.05, 0.3])
def test_it_is_the_true_error(length, deviation):
    truth = waves(length)
    output, estimate = denoised(truth, deviation)
    true = (output - truth).square().mean().item()
    estimated = (estimate.squared_error * estimate.radiance_scale.square()).mean().item()
    chance = 3 * 2 * deviation**2 / 2 / (3 * SIZE[0] * SIZE[1]) ** 0.5
    assert estimated == pytest.approx(true, rel=0.08, abs=chance)
    mapped = estimate.radiance_error().square().mean().item()  # its lower bound only adds to it
    assert 0.8 * true < mapped < 1.5 * true + chance
    assert estimate.max_relative_error() >= estimate.relative_error()


def test_the_error_of_the_mean_of_two_passes_is_unbiased():
    """Against the known variance and bias of a mean of 25 pixels."""
    truth = waves(12)
    deviation = 0.4
    a, b = noisy_buffers(truth, deviation)
    passes = [F.avg_pool2d(buffer, 5, 1, 2, count_include_pad=False) for buffer in (a, b)]
    mean = (passes[0] + passes[1]) / 2
    estimate = estimate_error(with_buffers(a, b), mean, passes, [a, b], torch.zeros(SHAPES))
    scale = estimate.radiance_scale.square()
    inner = (..., slice(4, -4), slice(4, -4))
    bias = F.avg_pool2d(truth, 5, 1, 2, count_include_pad=False) - truth
    variance = F.avg_pool2d((deviation * truth).square(), 5, 1, 2) / 25 / 2
    expected = (bias.square() + variance)[inner].mean().item()
    assert (estimate.filter_error * scale)[inner].mean().item() == pytest.approx(expected, rel=0.06)
    assert (estimate.filter_variance * scale)[inner].mean().item() == pytest.approx(
        variance[inner].mean().item(), rel=0.06
    )
    own = ((deviation * truth).square() / 2 / 25)[inner].mean().item()  # each pixel's noise is a 25th of its mean
    assert (estimate.covariance * scale)[inner].mean().item() == pytest.approx(own, rel=0.06)


def test_the_number_of_samples_for_an_error():
    """Where error and noise are uniform, the error falls by (e² + v) / (k e² + v)."""
    truth = waves(9)
    deviation = 0.5
    _, estimate = denoised(truth, deviation)
    target = estimate.relative_error() / 2
    e2, v = estimate.surface_mean(estimate.filter_error), estimate.surface_mean(estimate.variance)
    assert estimate.samples_for(target) == pytest.approx(8 * (4 * (e2 + v) - v) / e2, rel=0.3)
    assert estimate.samples_for(10.0) == 8  # those of the frame
    assert estimate.samples_for(1e-9) == float("inf")
    assert estimate.samples_for(1.2 * target) < estimate.samples_for(target)


def test_equal_buffers_have_no_error():
    image = 0.1 + torch.rand(1, 3, 40, 40)
    frame = replace(with_buffers(image, image), spp=torch.full((1, 1, 1, 1), 1e9))
    output, _, estimate = denoise_with_error(JamesStein(Blur()), frame, None)
    torch.testing.assert_close(output, image)
    assert estimate.radiance_error().max() < 1e-5 and estimate.relative_error() < 1e-5


def test_a_frame_without_buffers_is_refused():
    with pytest.raises(BadInput, match="sample buffers"):
        denoise_with_error(JamesStein(Blur()), flat_frame(8, 8, irradiance=torch.ones(1, 3, 8, 8)), None)


def test_the_output_is_that_of_the_denoiser():
    a, b = noisy_buffers(waves(20), 0.3)
    frame = with_buffers(a, b)
    denoiser = JamesStein(Blur())
    torch.testing.assert_close(denoise_with_error(denoiser, frame, None)[0], denoiser(frame, None)[0])


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    height=st.integers(1, 12),
    width=st.integers(1, 12),
    levels=st.lists(st.sampled_from([0.0, 1e-30, 1e-4, 1.0, 6e4, 1e20]), min_size=2, max_size=2),
    background=st.booleans(),
)
def test_estimates_are_finite_for_any_buffers(seed, height, width, levels, background):
    generator = torch.Generator().manual_seed(seed)
    a, b = (level * torch.rand(1, 3, height, width, generator=generator) for level in levels)
    mesh = torch.randint(0, 3, (1, 1, height, width), generator=generator).float()
    depth = mesh if background else mesh + 1
    output, _, estimate = denoise_with_error(JamesStein(Blur()), with_buffers(a, b, mesh_id=mesh, depth=depth), None)
    error = estimate.radiance_error()
    assert torch.isfinite(output).all() and torch.isfinite(error).all() and (error >= 0).all()
    assert ((error == 0) | (depth > 0)).all()
    assert 0 <= estimate.relative_error() <= estimate.max_relative_error() < float("inf")
    assert estimate.samples_for(0.02) >= 8 and estimate.samples_for(0.0) >= 8


def test_the_error_of_a_firefly_is_local():
    a, b = noisy_buffers(torch.ones(1, 3, 64, 64), 0.3)
    a[..., 32, 32] = 1e4
    _, _, estimate = denoise_with_error(JamesStein(Blur()), with_buffers(a, b), None)
    error = estimate.radiance_error()
    assert torch.isfinite(error).all()
    assert error[..., :8, :8].max() < 0.5
