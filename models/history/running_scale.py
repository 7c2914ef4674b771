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


def log_luminance_and_depth(radiance: Tensor, depth: Tensor) -> Tensor:
    """Logarithms of one frame's mean luminance and of its median depth, both of surfaces alone: (B, 2).

    `radiance` (B, 3, H, W) is noisy direct + indirect light. NaN where a frame is black, or has no surface.
    """

    def block_means(image: Tensor) -> Tensor:
        return F.avg_pool2d(image, LUMINANCE_BLOCK, ceil_mode=True, count_include_pad=False).flatten(1).double()

    surface = (depth > 0).to(radiance)
    share = block_means(surface)
    has_surface = share > 0
    y = block_means(image_luminance(radiance).clamp(min=0) * surface) / torch.where(has_surface, share, 1)
    blocks = has_surface.sum(dim=1).clamp(min=1)
    mean = y.sum(dim=1) / blocks
    log_y = torch.log(torch.maximum(y, 1e-4 * mean[:, None]).clamp(min=1e-300)) * has_surface
    log_y = (log_y.sum(dim=1) / blocks).to(radiance.dtype)
    stride_y, stride_x = (max(1, size // MEDIAN_GRID) for size in depth.shape[-2:])
    depths = depth[..., ::stride_y, ::stride_x].flatten(1)
    median = torch.where(depths > 0, depths, torch.nan).nanmedian(dim=1).values
    return torch.stack([torch.where(mean > 0, log_y, torch.nan), torch.log(median)], dim=1)


def running_scale(
    radiance: Tensor, depth: Tensor, previous: RunningScale | None, whole: Tensor | None = None
) -> RunningScale:
    """Update the estimates with one frame, see `log_luminance_and_depth`; where that is NaN, they stay.

    Of a training crop, `whole` (B, 2) are the logarithms of the frame that it was cut from.
    """
    if previous is None:  # exposure 1 and depth scale 1, until the first valid frame
        zero = radiance.new_zeros(len(radiance))
        previous = RunningScale(RunningMean(zero + math.log(MIDDLE_GREY), zero), RunningMean(zero, zero))
    new = log_luminance_and_depth(radiance, depth) if whole is None else whole
    log_luminance, log_depth = new.to(radiance).unbind(dim=1)
    return RunningScale(
        previous.log_luminance.update(log_luminance, ~log_luminance.isnan()),
        previous.log_depth.update(log_depth, ~log_depth.isnan()),
    )
