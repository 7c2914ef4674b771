"""Inputs of LBF's network: statistics of the features in windows of each pixel (Kalantari et al. 2015, §3.3).

All take features (B, sum(FEATURE_GROUPS), H, W) and `surface` (B, 1, H, W), 1 for pixels that count: background and
what is outside the image is in none of them. Statistics are taken by channel, then averaged over those of a group.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.cross_bilateral import FEATURE_GROUPS
from models.networks.pixel_kernels import window_taps
from models.operators import pad_to_multiple

BLOCK = 7  # px: what statistics are taken of
SMALL_BLOCK = 3
GAUSSIAN_MEDIAN = 0.6745  # of the absolute value of normal noise of deviation 1
SPREAD = 0.01  # the network cannot distinguish spreads far below this
KINDS = 7  # of statistics, one for each group
SECONDARY = KINDS * len(FEATURE_GROUPS) + 1


def box_sum(image: Tensor, side: int) -> Tensor:
    """Sums of (B, C, H, W) over blocks of side x side pixels around each."""
    return F.avg_pool2d(image, side, stride=1, padding=side // 2, divisor_override=1)


def block_statistics(features: Tensor, surface: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation over blocks of 7 x 7 pixels."""
    exact = features.double()  # squares too: the rounding of a square in float32 would look like a spread of 2e-4 of it
    counted = torch.cat([exact, exact.square(), torch.ones_like(surface)], dim=1) * surface
    count = features.shape[1]
    total, square, pixels = box_sum(counted, BLOCK).split([count, count, 1], dim=1)
    mean = total / pixels.clamp(min=1)
    variance = (square - mean * total).clamp(min=0) / (pixels - 1).clamp(min=1)
    return mean.to(features), variance.sqrt().to(features)


def mean_deviation(features: Tensor, surface: Tensor) -> Tensor:
    """Mean absolute difference of the pixels in blocks of 3 x 3 from the blocks' means."""
    pixels = box_sum(surface, SMALL_BLOCK).clamp(min=1)
    mean = box_sum(features * surface, SMALL_BLOCK) / pixels
    total = torch.zeros_like(features)
    for _, here, there in window_taps(SMALL_BLOCK, *surface.shape[-2:]):
        total[here] += (features[there] - mean[here]).abs() * surface[there]
    return total / pixels


def gradients(features: Tensor, surface: Tensor) -> Tensor:
    """How much features change from pixel to pixel, by Sobel; what does not count takes the value of the pixel."""
    across = torch.zeros_like(features)
    down = torch.zeros_like(features)
    for index, here, there in window_taps(3, *surface.shape[-2:]):
        dy, dx = (offset - 1 for offset in divmod(index, 3))
        step = (features[there] - features[here]) * surface[there] / 8
        across[here] += dx * (2 - abs(dy)) * step
        down[here] += dy * (2 - abs(dx)) * step
    return torch.hypot(across, down)


def noise(features: Tensor, surface: Tensor) -> Tensor:
    """The standard deviation of noise, by the median absolute deviation (MAD) of Haar wavelets' details.

    The details of 2 x 2 pixels, diagonal to diagonal, around which the median is taken over 4 x 4 of them; of the
    results, the largest of 3 x 3 pixels. Details that are not all of surfaces count as 0.
    """
    height, width = surface.shape[-2:]
    values, shown = (pad_to_multiple(x, 2).unflatten(3, (-1, 2)).unflatten(2, (-1, 2)) for x in (features, surface))
    signs = torch.tensor([[1.0, -1.0], [-1.0, 1.0]]).to(features)[:, None]
    details = ((signs * values).sum(dim=(3, 5)) / 2).abs() * shown.amin(dim=(3, 5))
    blocks = F.pad(details, (2, 1, 2, 1), mode="replicate").unfold(2, 4, 1).unfold(3, 4, 1).flatten(4)
    medians = [channel.sort(dim=-1).values[..., 7:9].mean(dim=-1) for channel in blocks.unbind(dim=1)]
    median = torch.stack(medians, dim=1)
    pixels = F.interpolate(median / GAUSSIAN_MEDIAN, scale_factor=2.0)[..., :height, :width]
    return F.max_pool2d(pixels, 3, stride=1, padding=1)


def group_means(features: Tensor) -> Tensor:
    """Means over the channels of each group, (B, groups, H, W)."""
    return torch.cat([group.mean(dim=1, keepdim=True) for group in features.split(FEATURE_GROUPS, dim=1)], dim=1)


def secondary_features(features: Tensor, variance: Tensor, surface: Tensor, samples: Tensor) -> Tensor:
    """The network's input, (B, SECONDARY, H, W).

    Of each group: noise, mean deviation, gradient, deviation of the pixel and of the block around, values of the pixel,
    their mean over the block; last, 1 / `samples`, which are (B, 1, 1, 1). `variance` (B, groups, H, W) is that of the
    noise in features. Values go in as they are, spreads x as ln(1 + x / SPREAD).
    """
    mean, deviation = block_statistics(features, surface)
    spreads = [group_means(kind(features, surface)) for kind in (noise, mean_deviation, gradients)]
    spreads += [variance.sqrt(), group_means(deviation)]
    means = [group_means(features), group_means(mean), (1 / samples).expand_as(surface)]
    return torch.cat([*(torch.log1p(spread / SPREAD) for spread in spreads), *means], dim=1)
