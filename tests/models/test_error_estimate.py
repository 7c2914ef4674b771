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
from models.registry import create
from models.wrappers.error_estimate import ErrorEstimate, denoise_with_error, estimate_error
from models.wrappers.shrinkage import JamesStein
from tests.helpers.buffers import any_images, noisy_buffers, with_buffers
from tests.helpers.frames import flat_frame
from tests.models.test_glass_layers import glass_frame

SIZE = (256, 256)
SHAPES = (1, 3, *SIZE)


def blur(image: Tensor) -> Tensor:
    """Means over 5 x 5 pixels: biased where the truth is curved, and correlated with the noise of the pixel itself."""
    return F.avg_pool2d(image, 5, 1, 2, count_include_pad=False)


class Blur(Denoiser):
    reads = ("direct", "indirect", "emission", "albedo", "depth")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return frame.remodulate(blur(frame.irradiance(self.signal)), self.signal), State(frame.moment)


def waves(length: float) -> Tensor:
    """Irradiance (1, 3, H, W) that oscillates by a half, with this wavelength in pixels."""
    x = torch.arange(SIZE[1]) * (2 * torch.pi / length)
    return (1 + torch.sin(x) / 2).expand(SHAPES).clone()


def denoised(frame: Frame) -> tuple[Tensor, ErrorEstimate]:
    output, _, estimate = denoise_with_error(JamesStein(Blur()), frame, None)
    return output, estimate


@pytest.mark.parametrize("length", [8.0, 30.0, 1e6])
@pytest.mark.parametrize("deviation", [0.05, 0.3])
def test_it_is_the_true_error(length, deviation):
    truth = waves(length)
    output, estimate = denoised(with_buffers(*noisy_buffers(truth, deviation)))
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
    passes = [blur(buffer) for buffer in (a, b)]
    mean = (passes[0] + passes[1]) / 2
    estimate = estimate_error(with_buffers(a, b), mean, passes, [a, b], torch.zeros(SHAPES))
    scale = estimate.radiance_scale.square()
    inner = (..., slice(4, -4), slice(4, -4))
    bias = blur(truth) - truth
    variance = blur((deviation * truth).square()) / 25 / 2
    own = (deviation * truth).square() / 2 / 25  # each pixel's noise is a 25th of its mean
    parts = [estimate.filter_error, estimate.filter_variance, estimate.covariance]
    for estimated, expected in zip(parts, (bias.square() + variance, variance, own), strict=True):
        assert (estimated * scale)[inner].mean().item() == pytest.approx(expected[inner].mean().item(), rel=0.06)


def test_the_number_of_samples_for_an_error():
    """Where error and noise are uniform, the error falls by (e² + v) / (k e² + v)."""
    truth = waves(9)
    deviation = 0.5
    _, estimate = denoised(with_buffers(*noisy_buffers(truth, deviation)))
    target = estimate.relative_error() / 2
    e2, v = estimate.surface_mean(estimate.filter_error), estimate.surface_mean(estimate.variance)
    assert estimate.samples_for(target) == pytest.approx(8 * (4 * (e2 + v) - v) / e2, rel=0.3)
    assert estimate.samples_for(10.0) == 8  # those of the frame
    assert estimate.samples_for(1e-9) == float("inf")
    assert estimate.samples_for(1.2 * target) < estimate.samples_for(target)


def test_equal_buffers_have_no_error():
    image = 0.1 + torch.rand(1, 3, 40, 40)
    frame = replace(with_buffers(image, image), spp=torch.full((1, 1, 1, 1), 1e9))
    output, estimate = denoised(frame)
    torch.testing.assert_close(output, image)
    assert estimate.radiance_error().max() < 1e-5 and estimate.relative_error() < 1e-5


def test_a_frame_without_buffers_is_refused():
    with pytest.raises(BadInput, match="sample buffers"):
        denoised(flat_frame(8, 8))


def test_the_output_is_that_of_the_denoiser():
    frame = with_buffers(*noisy_buffers(waves(20), 0.3))
    torch.testing.assert_close(denoised(frame)[0], JamesStein(Blur())(frame, None)[0])


@pytest.mark.parametrize("name", ["accumulated+js", "accumulated+taa+js"])
def test_glass_is_denoised_in_layers_and_its_error_has_the_history(name):
    denoiser = create(name)
    state, expected_state = None, None
    for seed in range(2):
        frame = glass_frame(seed, noise=1.0)
        for light in ("direct", "indirect"):
            halves = torch.stack([share * frame.channel(light) for share in (0.5, 1.5)], dim=1)
            frame = frame.with_channels({f"{light}_buffers": halves})
        output, state, estimate = denoise_with_error(denoiser, frame, state)
        expected, expected_state = denoiser(frame, expected_state)
        assert torch.equal(output, expected)
    _, _, without_history = denoise_with_error(denoiser, frame, None)
    assert estimate.filter_variance.mean() < 0.5 * without_history.filter_variance.mean()


@settings(max_examples=40, deadline=None)
@given(images=any_images(2, [0.0, 1e-30, 1e-4, 1.0, 6e4, 1e20]), background=st.booleans())
def test_estimates_are_finite_for_any_buffers(images, background):
    mesh, a, b = images
    depth = mesh if background else mesh + 1
    output, estimate = denoised(with_buffers(a, b, mesh_id=mesh, depth=depth))
    error = estimate.radiance_error()
    assert torch.isfinite(output).all() and torch.isfinite(error).all() and (error >= 0).all()
    assert ((error == 0) | (depth > 0)).all()
    assert 0 <= estimate.relative_error() <= estimate.max_relative_error() < float("inf")
    assert estimate.samples_for(0.02) >= 8 and estimate.samples_for(0.0) >= 8


def test_the_error_of_a_firefly_is_local():
    a, b = noisy_buffers(torch.ones(1, 3, 64, 64), 0.3)
    a[..., 32, 32] = 1e4
    _, estimate = denoised(with_buffers(a, b))
    error = estimate.radiance_error()
    assert torch.isfinite(error).all()
    assert error[..., :8, :8].max() < 0.5
