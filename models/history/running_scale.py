"""Causal estimates of a sequence's brightness and depth, which networks normalise by in place of a clip's exposure."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from models.operators import image_luminance

MIDDLE_GREY = 0.18  # the exposed geometric mean of luminance
MIN_RATE = 0.1  # weight of the newest frame in running estimates, once they have settled
MEDIAN_GRID = 64  # the median depth of large images is taken from about as many rows and columns
LUMINANCE_BLOCK = 16  # px; the logarithm of a mean over a block is far less biased than that of single samples


@dataclass(frozen=True)
class RunningMean:
    """A causal mean over frames, (B,): even at first, then with weight 0.1 for the newest."""

    value: Tensor
    count: Tensor  # frames that contributed

    def update(self, new: Tensor, valid: Tensor) -> "RunningMean":
        """With one more frame's `new` (B,), where `valid` (B,)."""
        count = self.count + valid
        rate = (1 / count.clamp(min=1)).clamp(min=MIN_RATE)
        return RunningMean(torch.where(valid, torch.lerp(self.value, new, rate), self.value), count)


@dataclass(frozen=True)
class RunningScale:
    """Running means of the logarithms of a sequence's luminance and depth."""

    log_luminance: RunningMean
    log_depth: RunningMean

    def exposure(self) -> Tensor:
        """0.18 / geometric mean luminance, (B, 1, 1, 1)."""
        return (MIDDLE_GREY * torch.exp(-self.log_luminance.value))[:, None, None, None]

    def normalised_depth(self, depth: Tensor) -> Tensor:
        """d / (d + s) in [0, 1) with s the running median depth; 1 for background (depth 0)."""
        scale = torch.exp(self.log_depth.value)[:, None, None, None]
        return torch.where(depth > 0, depth / (depth + scale), 1)


def block_luminances(radiance: Tensor, depth: Tensor) -> Tensor:
    """Mean luminances (B, blocks) of the surfaces in each block, float64; NaN where it shows none.

    `radiance` (B, 3, H, W) is noisy direct + indirect light.
    """

    def block_means(image: Tensor) -> Tensor:
        return F.avg_pool2d(image, LUMINANCE_BLOCK, ceil_mode=True, count_include_pad=False).flatten(1).double()

    surface = (depth > 0).to(radiance)
    share = block_means(surface)
    return block_means(image_luminance(radiance).clamp(min=0) * surface) / torch.where(share > 0, share, torch.nan)


def log_luminance(luminances: Tensor) -> Tensor:
    """The mean logarithm (B,) of the luminances of a frame's blocks; NaN where it is black, or has no surface."""
    has_surface = ~luminances.isnan()
    y = torch.where(has_surface, luminances, 0)
    blocks = has_surface.sum(dim=1).clamp(min=1)
    mean = y.sum(dim=1) / blocks
    log_y = torch.log(torch.maximum(y, 1e-4 * mean[:, None]).clamp(min=1e-300)) * has_surface
    return torch.where(mean > 0, log_y.sum(dim=1) / blocks, torch.nan).float()


def log_depth(depth: Tensor) -> Tensor:
    """The logarithm (B,) of the median depth of a frame's surfaces; NaN where it has none."""
    stride_y, stride_x = (max(1, size // MEDIAN_GRID) for size in depth.shape[-2:])
    depths = depth[..., ::stride_y, ::stride_x].flatten(1)
    return torch.log(torch.where(depths > 0, depths, torch.nan).nanmedian(dim=1).values)


def running_scale(
    radiance: Tensor, depth: Tensor, previous: RunningScale | None, whole: Tensor | None = None
) -> RunningScale:
    """Update the estimates with `log_luminance` and `log_depth` of one frame; where these are NaN, they stay.

    `radiance` (B, 3, H, W) is noisy direct + indirect light. Of a training crop, `whole` (B, 2) are both logarithms of
    the frame that it was cut from.
    """
    if previous is None:  # exposure 1 and depth scale 1, until the first valid frame
        zero = radiance.new_zeros(len(radiance))
        previous = RunningScale(RunningMean(zero + math.log(MIDDLE_GREY), zero), RunningMean(zero, zero))
    if whole is None:
        whole = torch.stack([log_luminance(block_luminances(radiance, depth)), log_depth(depth)], dim=1)
    luminance, distance = whole.to(radiance).unbind(dim=1)
    return RunningScale(
        previous.log_luminance.update(luminance, ~luminance.isnan()),
        previous.log_depth.update(distance, ~distance.isnan()),
    )
