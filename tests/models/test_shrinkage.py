"""NAME+js: shrinkage against a slow version, its limits, and sample buffers at the extremes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from torch import Tensor

from datasets.frame import Frame
from models import registry
from models.denoiser import Denoiser, State
from models.wrappers import shrinkage
from models.wrappers.shrinkage import RARE_PIXELS, SCARCE_SAMPLES, STANDARD_ERRORS, JamesStein
from tests.helpers.buffers import any_images, noisy_buffers, with_buffers
from tests.helpers.frames import flat_frame, run
from tests.helpers.windows import mesh_window

SIZE = (24, 40)
COLOUR = torch.tensor([1.0, 0.5, 0.25])[None, :, None, None]


class FixedImage(Denoiser):
    """Returns a given image."""

    reads = ("direct", "indirect", "emission", "albedo", "depth")
    image: Tensor

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return frame.remodulate(self.image, self.signal), State(frame.moment)


def shrunk_to(image: Tensor, frame: Frame) -> Tensor:
    """The output for a denoiser that returns this irradiance."""
    inner = FixedImage()
    inner.image = image
    return run(JamesStein(inner), [frame])[0]


def slow_rho(difference: np.ndarray, variance: np.ndarray, mesh: np.ndarray, samples: float) -> np.ndarray:
    """ρ of one colour, pixel by pixel: windows of 3 x 3 taps of 3 x 3 sums, and so on, all of the same mesh."""

    def sums(image: np.ndarray, step: int) -> np.ndarray:
        out = np.zeros_like(image)
        for p in np.ndindex(mesh.shape):
            out[:, *p] = sum(image[:, *q] for q in mesh_window(mesh, p, 1, step))
        return out

    counted = np.stack([difference**2 - variance, difference**2, 2 * variance**2, variance, np.ones_like(variance)])
    small = sums(sums(counted, 1), 3)
    wide = sums(small, 9)
    widest = sums(wide, 27)
    mean_small, mean_wide = small / small[4], wide / wide[4]
    rare = RARE_PIXELS * widest[3] / widest[4]
    error_small, error_wide = (
        np.sqrt(mean[2] / each[4]) + (SCARCE_SAMPLES / samples * mean[1] + rare) / each[4]
        for mean, each in ((mean_small, small), (mean_wide, wide))
    )
    overall = np.clip((mean_wide[0] - STANDARD_ERRORS * error_wide) / mean_wide[1], 0, 1)
    correction = mean_small[0] - overall * mean_small[1]
    significant = np.maximum(0, 1 - (STANDARD_ERRORS * error_small / correction) ** 2)
    rho = np.clip(overall + significant * correction / mean_small[1], 0, 1)
    smooth = sums(np.stack([rho, np.ones_like(rho)]), 1)
    return np.asarray(smooth[0] / smooth[1])


def test_shrinkage_is_that_of_the_formula_pixel_by_pixel():
    rng = np.random.default_rng(3)
    truth = torch.from_numpy(rng.uniform(0.2, 2, (1, 3, *SIZE))).float()
    a, b = noisy_buffers(truth, 0.5)
    mesh = torch.ones(1, 1, *SIZE)
    mesh[..., 17:] = 2
    frame = with_buffers(a, b, mesh_id=mesh)
    denoised = 0.8 * truth.mean(dim=(2, 3), keepdim=True) * torch.ones_like(truth)
    output = shrunk_to(denoised, frame)
    luminance = (denoised[0, :, 0, 0] * torch.tensor([0.2126, 0.7152, 0.0722])).sum().item()
    unit = 1.01 * luminance  # of a uniform image
    for c in range(3):
        a_c, b_c, o = (image[0, c].double().numpy() for image in (a, b, denoised))
        rho = slow_rho(((a_c + b_c) / 2 - o) / unit, (a_c - b_c) ** 2 / 4 / unit**2, mesh[0, 0].numpy(), 8)
        assert 0 < rho.min() < 0.3 or rho.std() > 0.01
        np.testing.assert_allclose(output[0, c], o + rho * ((a_c + b_c) / 2 - o), rtol=2e-4)


def test_windows_that_missed_rare_light_do_not_count_as_dark(monkeypatch):
    """One pixel in 500 has the light of all: most windows seem darker than they are, and free of noise."""
    truth = torch.ones(1, 3, 81, 81)
    generator = torch.Generator().manual_seed(0)
    a, b = (500.0 * (torch.rand(1, 1, 81, 81, generator=generator) < 1 / 500) * truth for _ in range(2))
    frame = replace(with_buffers(a, b), spp=torch.full((1, 1, 1, 1), 64.0))

    def error() -> float:
        return float((shrunk_to(truth, frame) - truth).abs().mean())

    assert error() < 0.02
    monkeypatch.setattr(shrinkage, "RARE_PIXELS", 0.0)
    assert error() > 0.1


@pytest.mark.parametrize("deviation", [1.0, 0.5, 0.1, 0.02])
def test_it_is_no_worse_than_the_better_of_noise_and_denoiser(deviation):
    """The denoiser is 10 % off everywhere: many samples must converge to the truth, few to the denoiser."""
    truth = COLOUR * (1 + torch.sin(torch.arange(96.0) / 7)[None, None, None, :] / 2).expand(1, 1, 64, 96)
    a, b = noisy_buffers(truth, deviation)
    frame = with_buffers(a, b)
    denoised = 1.1 * truth
    output = shrunk_to(denoised, frame)
    errors = {
        name: float((image - truth).square().mean())
        for name, image in (("noise", (a + b) / 2), ("denoiser", denoised), ("shrunk", output))
    }
    assert errors["shrunk"] < 1.1 * min(errors["noise"], errors["denoiser"])
    if deviation == 0.1:  # where both errors are similar, the blend is better than both
        assert errors["shrunk"] < 0.8 * min(errors["noise"], errors["denoiser"])


def test_without_buffers_it_is_the_denoiser():
    frame = flat_frame(*SIZE, irradiance=torch.rand(1, 3, *SIZE))
    for name in ("svgf", "eaw+taa"):
        shrunk, plain = (run(registry.create(each), [frame]) for each in (f"{name}+js", name))
        torch.testing.assert_close(shrunk, plain, rtol=0, atol=0)


def test_a_few_black_samples_do_not_count_as_the_truth():
    """Few samples per pixel may all have missed the light of a small mesh; many would not."""
    mesh = torch.ones(1, 1, *SIZE)
    mesh[..., 10:12, 20:22] = 2
    a, b = noisy_buffers(COLOUR.expand(1, 3, *SIZE), 0.1)
    for buffer in (a, b):
        buffer[..., 10:12, 20:22] = 0
    denoised = COLOUR.expand(1, 3, *SIZE)
    for spp, kept in ((2.0, True), (1024.0, False)):
        frame = replace(with_buffers(a, b, mesh_id=mesh), spp=torch.full((1, 1, 1, 1), spp))
        output = shrunk_to(denoised, frame)[..., 10:12, 20:22]
        assert torch.allclose(output, COLOUR) == kept and (output.max() < 0.05) != kept


def test_a_firefly_in_one_buffer_is_suppressed():
    a, b = noisy_buffers(COLOUR.expand(1, 3, *SIZE), 0.3)
    clean = COLOUR.expand(1, 3, *SIZE)
    a[..., 12, 20] = 1e4
    output = shrunk_to(clean, with_buffers(a, b))
    assert output[..., 12, 20].max() < 20  # of 5000
    assert (output - clean).abs().median() < 0.05


@settings(max_examples=40, deadline=None)
@given(images=any_images(3, [0.0, 1e-30, 1e-4, 1.0, 6e4, 1e20, 1e34]))
def test_any_buffers_end_between_noise_and_denoiser(images):
    mesh, a, b, denoised = images
    output = shrunk_to(denoised, with_buffers(a, b, mesh_id=mesh, depth=mesh + 1))
    noisy = (a + b) / 2
    assert torch.isfinite(output).all()
    tolerance = 1e-5 * torch.maximum(noisy, denoised)
    assert (output >= torch.minimum(noisy, denoised) - tolerance).all()
    assert (output <= torch.maximum(noisy, denoised) + tolerance).all()
