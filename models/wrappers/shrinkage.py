"""NAME+js: a denoiser that converges, by James and Stein's shrinkage of noise to the denoised image (Gu et al. 2022).

A denoised image O has less noise than the mean N of a frame's samples, but an error that more samples do not reduce. Of
the images O + ρ (N - O) the one of least squared error has ρ = (Σ (N - O)² - v) / Σ (N - O)² over the pixels of a
window, where v is the variance of N and the noise of a pixel hardly depends on O there. From two independent sample
buffers A and B, (A - B)² / 4 estimates v without bias. So many samples converge to the truth, whatever the denoiser
does, and few of them to the denoiser's image.

Our own choices, by measurement:

- Irradiance is compared relative to the denoised one: a window's bright pixels must not outweigh the others.
- Windows are 27 x 27 and 9 x 9 pixels of the same mesh. The estimate is that of the wider, less STANDARD_ERRORS,
  corrected by that of the smaller where they differ by more than as many: where noise is large, chance would pass for
  signal. The standard error is that of Σ a b for the noise a and b of two buffers, sqrt(Σ 2 v²). Where all samples of a
  window have missed some light, it seems free of noise; so the error also includes the distance of SCARCE_SAMPLES /
  samples pixels, and the variance of RARE_PIXELS pixels of the surrounding 81 x 81 of the same mesh.
- ρ is averaged over 3 x 3 pixels of the same mesh.

Without sample buffers, as at one sample per pixel, it is the denoiser itself.
"""

import torch
from torch import Tensor

from datasets.channels import SAMPLE_BUFFERS
from datasets.frame import Frame, Signal
from models.denoiser import Denoiser, State
from models.filters.neighbours import mesh_sums, mesh_sums_9x9
from models.operators import MIN_DIVISOR, image_luminance
from models.wrappers.wrapper import Wrapper

STANDARD_ERRORS = 3.0
SCARCE_SAMPLES = 16.0  # per pixel
RARE_PIXELS = 2.0
MAX_RATIO = 1e6  # of noise to denoised irradiance; the square of a square must stay finite
MIN_RELATIVE_LUMINANCE = 0.01  # of the mean luminance: added to what irradiance is divided by


def window_means(sums: Tensor, rare: Tensor, samples: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means (B, 3, H, W) over windows: (N - O)² - v, the denoiser's own squared error; (N - O)²; the first's error.

    From sums (B, 13, H, W) of both, 2 v², v and 1, and the sum `rare` of light possibly missed. The error is standard.
    """
    pixels = sums[:, 12:]
    excess, distance, squares = (sums[:, :9] / pixels).chunk(3, dim=1)
    error = (squares / pixels).sqrt() + (SCARCE_SAMPLES / samples * distance + rare) / pixels
    return excess, distance.clamp(min=MIN_DIVISOR), error


def weight_of_noise(difference: Tensor, variance: Tensor, mesh_id: Tensor, samples: Tensor) -> Tensor:
    """ρ (B, 3, H, W) in [0, 1] from N - O and the variance of N, both relative to the denoised irradiance."""
    distance = difference.square()
    squares = [distance - variance, distance, 2 * variance.square(), variance]
    sums_9x9 = mesh_sums_9x9(torch.cat([*squares, torch.ones_like(mesh_id)], dim=1), mesh_id)
    sums_27x27 = mesh_sums(sums_9x9, mesh_id, 9)
    sums_81x81 = mesh_sums(sums_27x27[:, 9:], mesh_id, 27)
    rare = RARE_PIXELS * sums_81x81[:, :3] / sums_81x81[:, 3:]
    excess, distance, error = window_means(sums_27x27, rare, samples)
    overall = ((excess - STANDARD_ERRORS * error) / distance).clamp(0, 1)
    excess, distance, error = window_means(sums_9x9, rare, samples)
    correction = excess - overall * distance
    rho = (overall + significant_part(correction, error) * correction / distance).clamp(0, 1)
    return mesh_mean_3x3(rho, mesh_id)


def significant_part(difference: Tensor, error: Tensor) -> Tensor:
    """The part of a difference that is not chance, in [0, 1], given its standard error."""
    return 1 - (STANDARD_ERRORS * error / difference.abs().clamp(min=MIN_DIVISOR)).square().clamp(max=1)


def mesh_mean_3x3(image: Tensor, mesh_id: Tensor) -> Tensor:
    """Means (B, C, H, W) over 3 x 3 pixels of the same mesh."""
    sums = mesh_sums(torch.cat([image, torch.ones_like(mesh_id)], dim=1), mesh_id, 1)
    return sums[:, :-1] / sums[:, -1:]


def comparison_unit(luminance: Tensor) -> Tensor:
    """What irradiance is divided by to be compared, from the mean luminance near each pixel, (B, 1, H, W); never 0."""
    offset = MIN_RELATIVE_LUMINANCE * luminance.mean(dim=(1, 2, 3), keepdim=True)
    return (luminance + offset).clamp(min=MIN_DIVISOR)


def relative(difference: Tensor, unit: Tensor) -> Tensor:
    """A difference of irradiance (B, 3, H, W) over a unit (B, 1, H, W), clamped."""
    return (difference / unit).clamp(-MAX_RATIO, MAX_RATIO)


def shrinkage_weight(frame: Frame, denoised: Tensor, signal: Signal) -> Tensor:
    """ρ (B, 3, H, W) for a frame with sample buffers and its denoised irradiance (B, 3, H, W)."""
    a, b = (frame.buffer(which).irradiance(signal) for which in (0, 1))
    unit = comparison_unit(mesh_mean_3x3(image_luminance(denoised), frame.mesh_id))
    error_a, error_b = (relative(buffer - denoised, unit) for buffer in (a, b))
    return weight_of_noise((error_a + error_b) / 2, (error_a - error_b).square() / 4, frame.mesh_id, frame.samples)


def blend(frame: Frame, denoised: Tensor, rho: Tensor, signal: Signal) -> Tensor:
    """O + ρ (N - O), irradiance (B, 3, H, W)."""
    return torch.lerp(denoised, frame.irradiance(signal), rho).clamp(min=0)


class JamesStein(Wrapper):
    """Shrinkage of noise to a denoiser's output, where frames have sample buffers. Its state is the inner one's."""

    needs = ("albedo", "depth", "mesh_id")

    def __init__(self, inner: Denoiser):
        super().__init__(inner)
        buffers = (SAMPLE_BUFFERS[name] for name in SAMPLE_BUFFERS if name in inner.reads)
        self.reads = tuple(dict.fromkeys((*self.reads, *buffers)))

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        output, after = self.inner.run(frame, state)
        if not frame.has_buffers:
            return output, after
        return self.shrunk(frame, *self.weighed(frame, output)), after

    def weighed(self, frame: Frame, output: Tensor) -> tuple[Tensor, Tensor]:
        """The irradiance of the inner denoiser's `output`, and ρ, of a frame with sample buffers."""
        denoised = frame.demodulate(output, self.signal)
        return denoised, shrinkage_weight(frame, denoised, self.signal)

    def shrunk(self, frame: Frame, denoised: Tensor, rho: Tensor) -> Tensor:
        """Radiance (B, 3, H, W) of O + ρ (N - O)."""
        return frame.remodulate(blend(frame, denoised, rho, self.signal), self.signal)
