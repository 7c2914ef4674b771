"""Strata, squares of 3 x 3 pixels: what is estimated of light's change is estimated at their resolution.

Those at the right and at the bottom of an image may have fewer pixels.
"""

from torch import Tensor
from torch.nn import functional as F

STRATUM = 3  # px; render/gradient.py has the same


def sums(image: Tensor) -> Tensor:
    """The sum over each stratum, (B, C, h, w), of an image (B, C, H, W)."""
    return F.avg_pool2d(image, STRATUM, ceil_mode=True, divisor_override=1)


def middles(image: Tensor) -> Tensor:
    """The pixel in the middle of each stratum, (B, C, h, w), of an image (B, C, H, W); the last one of smaller ones."""
    right = -image.shape[-1] % STRATUM
    bottom = -image.shape[-2] % STRATUM
    whole = F.pad(image, (0, right, 0, bottom), mode="replicate")
    return whole[..., STRATUM // 2 :: STRATUM, STRATUM // 2 :: STRATUM].contiguous()


def repeated(strata: Tensor, size: tuple[int, int]) -> Tensor:
    """An image (B, C, H, W) of `size` (H, W) whose pixels have the values (B, C, h, w) of their strata."""
    height, width = size
    return strata.repeat_interleave(STRATUM, dim=-2).repeat_interleave(STRATUM, dim=-1)[..., :height, :width]
