"""Small operators on images. Tensors are (B, C, H, W), float32."""

from functools import partial

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.channels import LUMINANCE_WEIGHTS
from models.history.geometry import pixel_centres

MAX_LUMINANCE = 1e16  # its square must stay finite
STRIP_PIXELS = 1 << 20  # networks take larger images in strips of about so many
MAX_IRRADIANCE = 1e30  # sums with weights of exp(10) must stay finite
MIN_DIVISOR = 1e-30  # keeps quotients finite where lengths, depths, variances or sums of weights are 0
STRIP_ROWS = 64  # of images that are worked on in strips: temporaries stay in the cache, two threads have enough to do


def finite(x: Tensor) -> Tensor:
    """NaN and infinities become 0."""
    return torch.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0)


def image_luminance(rgb: Tensor) -> Tensor:
    """Rec. 709 luminance (B, 1, H, W) of linear `rgb` (B, 3, H, W)."""
    return (rgb * torch.tensor(LUMINANCE_WEIGHTS, dtype=torch.float64).to(rgb)[:, None, None]).sum(dim=1, keepdim=True)


def block_sums(image: Tensor, size: int) -> Tensor:
    """Sums (B, C, h, w) of an image (B, C, H, W) over blocks of `size` x `size` pixels, fewer at the far borders."""
    return F.avg_pool2d(image, size, ceil_mode=True, divisor_override=1)


def halve(image: Tensor, surface: Tensor | None = None) -> Tensor:
    """Means of 2 x 2 pixels, fewer at odd borders: (B, C, H, W) becomes half as large, rounded up.

    Only pixels that show a `surface` count (see Frame.surface); without any, the mean is 0.
    """
    mean = partial(F.avg_pool2d, kernel_size=2, ceil_mode=True, count_include_pad=False)
    if surface is None:
        return mean(image)
    return mean(image * surface) / mean(surface).clamp(min=1 / 4)


def halve_surface(surface: Tensor) -> Tensor:
    """The surface (B, 1, H, W) of an image after `halve`: where any of the 2 x 2 pixels shows one."""
    return F.max_pool2d(surface, 2, ceil_mode=True)


def pyramid(image: Tensor, surface: Tensor | None, levels: int) -> list[tuple[Tensor, Tensor | None]]:
    """An image halved level by level, each with its surface, coarse to fine."""
    pairs = [(image, surface)]
    for _ in range(levels - 1):
        image = halve(image, surface)
        surface = None if surface is None else halve_surface(surface)
        pairs.append((image, surface))
    return pairs[::-1]


def pad_to_multiple(x: Tensor, multiple: int) -> Tensor:
    """Replicate the right and bottom borders until both sides are multiples of `multiple`."""
    right = -x.shape[-1] % multiple
    bottom = -x.shape[-2] % multiple
    return F.pad(x, (0, right, 0, bottom), mode="replicate") if right or bottom else x


def sampling_grid(motion: Tensor) -> Tensor:
    """Where F.grid_sample fetches what `motion` (B, 2, H, W), in pixels, leads each pixel to: (B, H, W, 2)."""
    height, width = motion.shape[-2:]
    x, y = pixel_centres(height, width, motion)
    # Far outside the image an index would overflow; any place outside is as good.
    x = (x + motion[:, 0]).clamp(-1, width + 1) * (2 / width) - 1
    y = (y + motion[:, 1]).clamp(-1, height + 1) * (2 / height) - 1
    return torch.stack([x, y], dim=-1)
