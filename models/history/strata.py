"""Strata, squares of 3 x 3 pixels, at whose resolution changes of light are estimated; smaller at the far borders."""

from torch import Tensor
from torch.nn import functional as F

from datasets.channels import STRATUM


def strata_sums(image: Tensor) -> Tensor:
    """The sum over each stratum, (B, C, h, w), of an image (B, C, H, W)."""
    return F.avg_pool2d(image, STRATUM, ceil_mode=True, divisor_override=1)


def strata_centres(image: Tensor) -> Tensor:
    """The centre pixel of each stratum, (B, C, h, w), of an image (B, C, H, W); the last pixel of smaller ones."""
    right = -image.shape[-1] % STRATUM
    bottom = -image.shape[-2] % STRATUM
    padded = F.pad(image, (0, right, 0, bottom), mode="replicate")
    return padded[..., STRATUM // 2 :: STRATUM, STRATUM // 2 :: STRATUM].contiguous()


def repeat_strata(strata: Tensor, size: tuple[int, int]) -> Tensor:
    """An image (B, C, H, W) of `size` (H, W) whose pixels have the values (B, C, h, w) of their strata."""
    height, width = size
    return strata.repeat_interleave(STRATUM, dim=-2).repeat_interleave(STRATUM, dim=-1)[..., :height, :width]
