"""A denoiser that converges: NAME+js. James and Stein's shrinkage of noise to the denoised image (Gu et al. 2022).

A denoised image O has less noise than the mean N of a frame's samples, but an error that more samples do not take away.
Of the images O + ρ (N - O) the one of least squared error has ρ = (Σ (N - O)² - v) / Σ (N - O)² over the pixels of a
window, where v is the variance of N, and the noise of a pixel has little to do with O there. With two independent
halves A and B of the samples, (A - B)² / 4 estimates v without bias. So more samples end at the truth, whatever the
denoiser does, and few of them at the denoiser.

What is ours, by measurement (docs/experiments.md, Shrinkage):

- Irradiance is compared, relative to what is denoised: a window's bright pixels must not speak for the others.
- Windows are 27 x 27 and 9 x 9 pixels of the own mesh. The wider one counts, less STANDARD_ERRORS, and the other so
  far as it differs by more than as many: where noise is large, chance would let it through. The error is that of
  Σ a b for noise a and b of two halves, sqrt(Σ 2 v²). All samples of a window may have missed the same light, and then
  seem to have no noise: so there is added what SCARCE / samples pixels have for distance, and RARE pixels for variance
  in the 81 x 81 of the own mesh around, where rare light was found.
- ρ is averaged over 3 x 3 pixels of the own mesh.

Without halves, as at one sample a pixel, it is the denoiser itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from datasets.channels import SAMPLE_BUFFERS
from datasets.frame import Frame, Signal
from models.denoiser import State
from models.filters.neighbours import mesh_sums
from models.operators import MIN_DIVISOR, image_luminance
from models.wrappers.wrapper import Wrapper

STANDARD_ERRORS = 3.0
SCARCE = 16.0  # samples a pixel
RARE = 2.0  # pixels
LARGEST_RATIO = 1e6  # of noise to what is denoised; the square of a square must stay finite
COMPARED_BY = ("albedo", "depth", "mesh_id")
DARKEST = 0.01  # of the mean luminance: what is darker is not compared relative to itself


class Window(NamedTuple):
    """Means over a window around each pixel, (B, 3, H, W)."""

    excess: Tensor  # (N - O)² - v: the denoiser's own squared error
    distance: Tensor  # (N - O)²
    error: Tensor  # standard error of `excess`


def windows(distance: Tensor, variance: Tensor, mesh_id: Tensor, samples: Tensor) -> tuple[Window, Window]:
    """Those of 9 x 9 and of 27 x 27 pixels of the own mesh, from squares (B, 3, H, W) of `samples` (B, 1, 1, 1)."""
    squares = [distance - variance, distance, 2 * variance.square(), variance]
    counted = torch.cat([*squares, torch.ones_like(mesh_id)], dim=1)
    small = mesh_sums(mesh_sums(counted, mesh_id, 1), mesh_id, 3)
    wide = mesh_sums(small, mesh_id, 9)
    around = mesh_sums(wide[:, 9:], mesh_id, 27)
    rare = RARE * around[:, :3] / around[:, 3:]
    return window_of(small, rare, samples), window_of(wide, rare, samples)


def window_of(sums: Tensor, rare: Tensor, samples: Tensor) -> Window:
    """From sums (B, 13, H, W) of the four and of the number of pixels, and the sum that light not found may have."""
    pixels = sums[:, 12:]
    excess, distance, squares = (sums[:, :9] / pixels).chunk(3, dim=1)
    error = (squares / pixels).sqrt() + (SCARCE / samples * distance + rare) / pixels
    return Window(excess, distance.clamp(min=MIN_DIVISOR), error)


def share_of_noise(difference: Tensor, variance: Tensor, mesh_id: Tensor, samples: Tensor) -> Tensor:
    """ρ (B, 3, H, W) in [0, 1], from N - O and the variance of N, relative to what is denoised."""
    small, wide = windows(difference.square(), variance, mesh_id, samples)
    overall = ((wide.excess - STANDARD_ERRORS * wide.error) / wide.distance).clamp(0, 1)
    off = small.excess - overall * small.distance
    rho = (overall + believed(off, small.error) * off / small.distance).clamp(0, 1)
    return mesh_means_of(rho, mesh_id)


def believed(difference: Tensor, error: Tensor) -> Tensor:
    """How much of a difference is no chance, in [0, 1], from its standard error."""
    doubt = STANDARD_ERRORS * error
    return 1 - (doubt / difference.abs().clamp(min=MIN_DIVISOR)).square().clamp(max=1)


def mesh_means_of(image: Tensor, mesh_id: Tensor) -> Tensor:
    """Means (B, C, H, W) over 3 x 3 pixels of the own mesh."""
    sums = mesh_sums(torch.cat([image, torch.ones_like(mesh_id)], dim=1), mesh_id, 1)
    return sums[:, :-1] / sums[:, -1:]


def denoised_irradiance(output: Tensor, frame: Frame, signal: Signal) -> Tensor:
    """What a denoiser made of the frame's irradiance, (B, 3, H, W), from the radiance that it returned."""
    reflected = output - frame.emission if signal == "total" else output
    return (reflected / frame.divisor).clamp(min=0)


def share_let_in(frame: Frame, denoised: Tensor, signal: Signal) -> Tensor:
    """ρ (B, 3, H, W) of a frame that has halves, for denoised irradiance (B, 3, H, W)."""
    a, b = (frame.buffer(which).irradiance(signal) for which in (0, 1))
    luminance = mesh_means_of(image_luminance(denoised), frame.mesh_id)
    unit = unit_of(luminance)
    off_a, off_b = (relative(half - denoised, unit) for half in (a, b))
    return share_of_noise((off_a + off_b) / 2, (off_a - off_b).square() / 4, frame.mesh_id, frame.samples)


def unit_of(luminance: Tensor) -> Tensor:
    """What irradiance is compared by, from the luminance around each pixel, (B, 1, H, W): it is never 0."""
    darkest = DARKEST * luminance.mean(dim=(1, 2, 3), keepdim=True)
    return (luminance + darkest).clamp(min=MIN_DIVISOR)


def relative(difference: Tensor, unit: Tensor) -> Tensor:
    """A difference of irradiance (B, 3, H, W) over a unit (B, 1, H, W), within bounds."""
    return (difference / unit).clamp(-LARGEST_RATIO, LARGEST_RATIO)


def mixture(frame: Frame, denoised: Tensor, share: Tensor, signal: Signal) -> Tensor:
    """Denoised irradiance (B, 3, H, W) with a share of the frame's own let in."""
    return torch.lerp(denoised, frame.irradiance(signal), share).clamp(min=0)


def shrunk(frame: Frame, denoised: Tensor, signal: Signal) -> Tensor:
    """The shrinkage of a frame that has halves to denoised irradiance (B, 3, H, W), as irradiance."""
    return mixture(frame, denoised, share_let_in(frame, denoised, signal), signal)


class Shrunk(Wrapper):
    """Shrinkage to a denoiser's output, where frames have halves. Its state is the inner one's."""

    def reads_with(self, reads: Sequence[str]) -> tuple[str, ...]:
        """With the halves of those that have any, and what shrinkage compares them by."""
        buffers = (SAMPLE_BUFFERS[name] for name in SAMPLE_BUFFERS if name in reads)
        return tuple(dict.fromkeys((*reads, *buffers, *COMPARED_BY)))

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        output, after = self.inner.forward(frame, state)
        if not frame.has_buffers:
            return output, after
        denoised = denoised_irradiance(output, frame, self.signal)
        return frame.remodulate(shrunk(frame, denoised, self.signal), self.signal), after
