"""A cross-bilateral filter with parameters of its own at every pixel: what LBF filters with (Kalantari et al. 2015).

    output(p) = sum_q w(p, q) image(q) / sum_q w(p, q)
    w(p, q) = exp(-s_0 |p - q|² - d(p, q) / 2 β² - sum_k s_k |f_k(p) - f_k(q)|²)

with the sharpnesses s of pixel p, features f_k and, as colours are noisy, their distance in units of the noise,
d(p, q) = sum (image(p) - image(q))² / (var(p) + var(q)), summed over colours.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from models import compiled
from models.compiled import cross_bilateral as kernels
from models.compiled.cross_bilateral import COLOUR_SHARPNESS, FEATURE_GROUPS, FILTER_RADIUS, MAX_EXPONENT
from models.networks.pixel_kernels import window_taps
from models.operators import MIN_DIVISOR

SIDE = 2 * FILTER_RADIUS + 1


class Pixels(NamedTuple):
    """What is filtered, and what pixels are compared by; all float32 and (B, ·, H, W)."""

    image: Tensor  # 3 channels
    variance: Tensor  # of the noise in each of these
    features: Tensor  # sum(FEATURE_GROUPS) channels
    surface: Tensor  # 1 for pixels that count, 0 for those that are left out like what is outside the image


def tap_weights(pixels: Pixels, sharpness: Tensor) -> Iterator[tuple[Any, Any, Tensor, Tensor]]:
    """Of each tap: the pixels that have it and those it is, as indices; w (B, 1, h, w); the distances that s scales.

    The distances (B, 1 + groups, h, w) are 0 where so little weight is left that it does not change with them.
    """
    image, variance, features, surface = pixels
    for index, here, there in window_taps(SIDE, *image.shape[-2:]):
        dy, dx = (offset - FILTER_RADIUS for offset in divmod(index, SIDE))
        noise = MIN_DIVISOR + variance[here] + variance[there]
        apart = ((image[there] - image[here]).square() / noise).sum(dim=1, keepdim=True)
        squares = (features[there] - features[here]).square().split(FEATURE_GROUPS, dim=1)
        in_image = torch.full_like(apart, dy * dy + dx * dx)
        distances = torch.cat([in_image, *(square.sum(dim=1, keepdim=True) for square in squares)], dim=1)
        exponent = COLOUR_SHARPNESS * apart + (sharpness[here] * distances).sum(dim=1, keepdim=True)
        weight = torch.exp(-exponent.clamp(max=MAX_EXPONENT)) * surface[there]
        yield here, there, weight, distances * (exponent < MAX_EXPONENT)


@compiled.by(kernels.weighted_mean)
def weighted_mean(pixels: Pixels, sharpness: Tensor) -> tuple[Tensor, Tensor]:
    """The filtered image, and the sums of weights (B, 1, H, W); both 0 off surfaces."""
    out = torch.zeros_like(pixels.image)
    total = torch.zeros_like(pixels.surface)
    for here, there, weight, _ in tap_weights(pixels, sharpness):
        out[here].addcmul_(weight, pixels.image[there])
        total[here] += weight
    return out * pixels.surface / total.clamp(min=MIN_DIVISOR), total * pixels.surface


@compiled.by(kernels.pull_sharpness)
def pull_sharpness(gradient: Tensor, pixels: Pixels, sharpness: Tensor, out: Tensor, total: Tensor) -> Tensor:
    """The gradient of the sharpness (B, 1 + groups, H, W), from that of what weighted_mean returned."""
    pulled = torch.zeros_like(sharpness)
    scaled = gradient * pixels.surface / total.clamp(min=MIN_DIVISOR)
    dot = (scaled * out).sum(dim=1, keepdim=True)
    for here, there, weight, distances in tap_weights(pixels, sharpness):
        pull = weight * ((scaled[here] * pixels.image[there]).sum(dim=1, keepdim=True) - dot[here])
        pulled[here].addcmul_(pull, distances, value=-1)
    return pulled


class CrossBilateral(torch.autograd.Function):
    """Computes all weights once more on the way back, rather than keep thousands of images."""

    @staticmethod
    def forward(ctx: Any, sharpness: Tensor, *pixels: Tensor) -> Tensor:
        out, total = weighted_mean(Pixels(*pixels), sharpness)
        ctx.save_for_backward(*pixels, sharpness, out, total)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        *pixels, sharpness, out, total = ctx.saved_tensors
        return pull_sharpness(gradients[0], Pixels(*pixels), sharpness, out, total), *[None] * len(pixels)


def cross_bilateral(pixels: Pixels, sharpness: Tensor) -> Tensor:
    """The filtered image (B, 3, H, W), a convex mean of surfaces around each pixel, 0 off them.

    Differentiable in the sharpness (B, 1 + groups, H, W) >= 0: that of the distance in the image, then of each group
    of features. Colours lie within ±MAX_LUMINANCE.
    """
    return cast(Tensor, CrossBilateral.apply(sharpness, *pixels))
