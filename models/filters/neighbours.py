"""The pixels around each pixel, some steps apart, and what those of its own mesh look like."""

import torch
from torch import Tensor
from torch.nn import functional as F

from models import compiled
from models.compiled import neighbours as kernels
from models.compiled.neighbours import MIN_MEAN
from models.operators import MAX_LUMINANCE, image_luminance


def shifted(x: Tensor, step: int) -> Tensor:
    """The 3 x 3 taps `step` pixels apart around every pixel of (B, C, H, W): (B, C, 9, H, W), 0 outside the image."""
    batch, channels, height, width = x.shape
    taps = F.unfold(x, 3, dilation=step, padding=step)
    return taps.view(batch, channels, 9, height, width)


@compiled.by(kernels.mesh_sums)
def mesh_sums(image: Tensor, mesh_id: Tensor, step: int) -> Tensor:
    """Sums (B, C, H, W) over those of the 3 x 3 taps that lie on the pixel's own mesh."""
    same = shifted(mesh_id + 1, step) == mesh_id[:, :, None] + 1
    return torch.where(same, shifted(image, step), 0).sum(dim=2)


def summands(image: Tensor) -> Tensor:
    """What mesh_means sums: the image (B, 3, H, W), its luminance, the square of that, and 1; (B, 6, H, W)."""
    luminance = image_luminance(image).clamp(max=MAX_LUMINANCE)
    return torch.cat([image, luminance, luminance.square(), torch.ones_like(luminance)], dim=1)


def means_of(close: Tensor, wide: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What mesh_means returns, of sums of summands over 3 x 3 pixels and over 9 x 9."""
    around, mean, square = (wide[:, :5] / wide[:, 5:]).split([3, 1, 1], dim=1)
    deviation = (square - mean.square()).clamp(min=0).sqrt() / mean.clamp(min=MIN_MEAN)
    return close[:, :3] / close[:, 5:], around, deviation


@compiled.by(kernels.mesh_means)
def mesh_means(image: Tensor, mesh_id: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means of the image (B, 3, H, W) over the pixel's own mesh, and how far luminance spreads there.

    The means (B, 3, H, W) are over 3 x 3 pixels, and over 9 x 9: over 3 x 3 sums like that, 3 pixels apart. The last is
    the relative standard deviation of luminance in the latter, (B, 1, H, W).
    """
    close = mesh_sums(summands(image), mesh_id, 1)
    return means_of(close, mesh_sums(close, mesh_id, 3))


def mesh_least(image: Tensor, mesh_id: Tensor) -> Tensor:
    """The least of each channel of the image (B, C, H, W) over the pixel's own mesh, of 3 x 3 pixels."""
    same = shifted(mesh_id + 1, 1) == mesh_id[:, :, None] + 1
    return torch.where(same, shifted(image, 1), torch.inf).amin(dim=2)


def mesh_variance(image: Tensor, mesh_id: Tensor) -> Tensor:
    """Variance (B, C, H, W) of each channel of the image over the pixel's own mesh, over 9 x 9 pixels as in mesh_means.

    Zero for the only pixel of a mesh there.
    """
    moments = torch.cat([image, image.square(), torch.ones_like(image[:, :1])], dim=1)
    sums = mesh_sums(mesh_sums(moments, mesh_id, 1), mesh_id, 3)
    mean, square = (sums[:, :-1] / sums[:, -1:]).chunk(2, dim=1)
    return (square - mean.square()).clamp(min=0)
