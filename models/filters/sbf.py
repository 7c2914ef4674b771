"""SBF: SURE-based filtering (Li et al. 2012) without its adaptive sampling: at each pixel the best of a filter bank.

The bank consists of cross-bilateral filters with spatial Gaussians of different widths. Stein's unbiased risk estimate
(SURE) gives the squared error of each from the noisy image c alone, (F(c) - c)² + 2 σ² dF/dc - σ², where σ² is the
variance of the noise.

Where the paper leaves it open, we choose:

- The filters have no range term on colour (σ_r = ∞), as in the authors' code, which reports noisy results with one. So
  they are linear in colours, and dF/dc is the share of the pixel in its own weights.
- σ_f are the defaults of the authors' code, 0.8 for normals, 0.25 for albedo, 0.6 for depth, times 0.1: it divides
  squared differences by max(variance, 0.01), and our features have none. Depth is divided by the frame's maximum.
- Windows end at 2 σ_s.
- As in SVGF's evaluation (Schied et al. 2017, §5.1), the light has been accumulated over frames.
- It filters irradiance, with albedo among the features. The paper filters radiance; but with one sample per pixel σ²
  has to be estimated from other pixels, where texture would count as noise.
- σ² is the variance of each colour over 9 x 9 pixels of the same mesh: that of the pixel as it is, whatever its number
  of samples.
- The risk is that of the frame as it is, not of a reconstruction-filtered one: our frames have no reconstruction
  filter, each sample counts for its own pixel alone.
- The risk of a filter is the mean over colours, smoothed by a filter of the bank's kind with σ_s = 8.
- The features of background are far from those of all surfaces, so that no surface gathers from it.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models import compiled
from models.compiled import sbf as kernels
from models.denoiser import CLASSICAL, State, matching_state
from models.filters.baselines import AccumulatedState, Accumulating
from models.filters.neighbours import mesh_variance
from models.operators import MAX_LUMINANCE, MIN_DIVISOR

BANK = tuple(2 ** (i / 2) for i in range(7))  # px; σ_s from 1 to 8
RISK_SIGMA = 8.0  # px
SBF_SIGMA_NORMAL = 0.08
SIGMA_ALBEDO = 0.025
SIGMA_DEPTH = 0.06  # of the frame's maximum
BACKGROUND_DEPTH = 1e3  # in σ; outside the image it is the negative of this
GATHERED_ROWS = 16  # filtered at once: all taps along a row are gathered


def gaussians(sigmas: Sequence[float]) -> Tensor:
    """Gaussians of offsets along an axis, each truncated at 2 σ: (2 radius + 1, S), with the radius of the widest."""
    widths = torch.tensor(sigmas)
    radii = (2 * widths).round()
    radius = int(radii.max())
    offsets = torch.arange(-radius, radius + 1)[:, None]
    return torch.where(offsets.abs() <= radii, torch.exp(-((offsets / widths) ** 2) / 2), 0)


def guides(frame: Frame) -> Tensor:
    """Features f (B, 7, H, W), scaled such that exp(-|f(p) - f(q)|²) is the product of their Gaussians."""
    max_depth = frame.depth.amax((2, 3), keepdim=True).clamp(min=MIN_DIVISOR)
    depth = torch.where(frame.depth > 0, frame.depth / max_depth / SIGMA_DEPTH, BACKGROUND_DEPTH)
    return torch.cat([frame.normal / SBF_SIGMA_NORMAL, frame.albedo / SIGMA_ALBEDO, depth], dim=1) / math.sqrt(2)


@compiled.by(kernels.window_sums)
def window_sums(image: Tensor, guides: Tensor, gaussians: Tensor) -> Tensor:
    """Sums (B, S, C, H, W) over windows of an image (B, C, H, W), with the weights of S cross-bilateral filters.

    A weight is exp(-|f(p) - f(q)|²) of `guides` f (B, F, H, W), times `gaussians` (2 radius + 1, S) along each axis.
    """
    taps = len(gaussians)
    padding = (taps // 2,) * 4
    padded_image = F.pad(image, padding)
    padded_guides = F.pad(guides, padding, value=-BACKGROUND_DEPTH)
    batch, channels, height, width = image.shape
    strips = []
    for top in range(0, height, GATHERED_ROWS):
        bottom = min(top + GATHERED_ROWS, height)
        centre = guides[:, :, top:bottom, :, None]
        sums = image.new_zeros(batch, channels, bottom - top, width, gaussians.shape[1])
        for dy in range(taps):
            rows = (..., slice(top + dy, bottom + dy), slice(None))
            row_guides = padded_guides[rows].unfold(-1, taps, 1)
            weight = (row_guides - centre).square_().sum(dim=1, keepdim=True).neg_().exp_()
            sums += (weight * padded_image[rows].unfold(-1, taps, 1)) @ (gaussians * gaussians[dy])
        strips.append(sums)
    return torch.cat(strips, dim=2).movedim(-1, 1)


def filter_with_risk(
    colour: Tensor, variance: Tensor, guides: Tensor, sigmas: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """Colour (B, 3, H, W) by filters of σ_s `sigmas`, and their risks, (B, S, 3, H, W), for noise of this variance."""
    image = torch.cat([colour, torch.ones_like(colour[:, :1])], dim=1)
    sums = window_sums(image, guides, gaussians(sigmas).to(colour))
    filtered = sums[:, :, :3] / sums[:, :, 3:]
    derivative = 1 / sums[:, :, 3:]  # a pixel's own weight is 1
    return filtered, (filtered - colour[:, None]).square() + (2 * derivative - 1) * variance[:, None]


def best_filtered(colour: Tensor, variance: Tensor, guides: Tensor) -> Tensor:
    """Colour (B, 3, H, W), at each pixel by the filter of BANK with the smallest smoothed risk."""
    filtered, risk = filter_with_risk(colour, variance, guides, BANK)
    smoothed = window_sums(risk.mean(dim=2), guides, gaussians([RISK_SIGMA]).to(colour))  # up to a factor
    return filtered.take_along_dim(smoothed.argmin(dim=2, keepdim=True), dim=1)[:, 0]


class SBF(Accumulating):
    """Filters accumulated irradiance within its [min, max] since the last reset."""

    made_from = "accounts, code"
    refuses = CLASSICAL
    convex = True

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        history = self.accumulated(frame, matching_state(state, AccumulatedState, frame))
        colour = history.irradiance.clamp(-MAX_LUMINANCE, MAX_LUMINANCE)
        filtered = best_filtered(colour, mesh_variance(colour, frame.mesh_id), guides(frame))
        return frame.remodulate(filtered, self.signal), AccumulatedState(frame.moment, history)
