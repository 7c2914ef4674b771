"""Neighbourhoods of pixels: 3 x 3 taps some steps apart, and statistics over those of the same mesh."""

import torch
from torch import Tensor
from torch.nn import functional as F

from models import compiled
from models.compiled import neighbours as kernels
from models.compiled.neighbours import MIN_MEAN
from models.operators import MAX_LUMINANCE, image_luminance


def taps_3x3(x: Tensor, step: int) -> Tensor:
    """The 3 x 3 taps, `step` pixels apart, of every pixel of (B, C, H, W): (B, C, 9, H, W), 0 outside the image."""
    return F.unfold(x, 3, dilation=step, padding=step).unflatten(2, x.shape[-2:]).unflatten(1, (-1, 9))


def taps_on_mesh(mesh_id: Tensor, step: int) -> Tensor:
    """Which of the 3 x 3 taps lie on the same mesh as the pixel: (B, 1, 9, H, W)."""
    return taps_3x3(mesh_id + 1, step) == mesh_id[:, :, None] + 1


@compiled.by(kernels.mesh_sums)
def mesh_sums(image: Tensor, mesh_id: Tensor, step: int) -> Tensor:
    """Sums (B, C, H, W) over those of the 3 x 3 taps that lie on the same mesh."""
    return torch.where(taps_on_mesh(mesh_id, step), taps_3x3(image, step), 0).sum(dim=2)


def mesh_sums_9x9(image: Tensor, mesh_id: Tensor) -> Tensor:
    """Sums (B, C, H, W) over 9 x 9 pixels of the same mesh: over 3 x 3 taps, 3 pixels apart, of sums over 3 x 3."""
    return mesh_sums(mesh_sums(image, mesh_id, 1), mesh_id, 3)


def summands(image: Tensor) -> Tensor:
    """What mesh_means sums: the image (B, 3, H, W), its luminance and luminance², and 1; (B, 6, H, W)."""
    luminance = image_luminance(image).clamp(max=MAX_LUMINANCE)
    return torch.cat([image, luminance, luminance.square(), torch.ones_like(luminance)], dim=1)


def means_of(sums_3x3: Tensor, sums_9x9: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The results of mesh_means, from sums of its summands over 3 x 3 and over 9 x 9 pixels."""
    mean_9x9, luminance, square = (sums_9x9[:, :5] / sums_9x9[:, 5:]).split([3, 1, 1], dim=1)
    deviation = (square - luminance.square()).clamp(min=0).sqrt() / luminance.clamp(min=MIN_MEAN)
    return sums_3x3[:, :3] / sums_3x3[:, 5:], mean_9x9, deviation


@compiled.by(kernels.mesh_means)
def mesh_means(image: Tensor, mesh_id: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Means (B, 3, H, W) of the image (B, 3, H, W) over 3 x 3 and over 9 x 9 pixels of the same mesh.

    Also the relative standard deviation of luminance over the 9 x 9 pixels, (B, 1, H, W).
    """
    sums_3x3 = mesh_sums(summands(image), mesh_id, 1)
    return means_of(sums_3x3, mesh_sums(sums_3x3, mesh_id, 3))


def mesh_min(image: Tensor, mesh_id: Tensor) -> Tensor:
    """The minimum of each channel of the image (B, C, H, W) over 3 x 3 pixels of the same mesh."""
    return torch.where(taps_on_mesh(mesh_id, 1), taps_3x3(image, 1), torch.inf).amin(dim=2)


def mesh_variance(image: Tensor, mesh_id: Tensor) -> Tensor:
    """Variance (B, C, H, W) of each channel of the image over 9 x 9 pixels of the same mesh; 0 for a single pixel."""
    sums = mesh_sums_9x9(torch.cat([image, image.square(), torch.ones_like(image[:, :1])], dim=1), mesh_id)
    mean, square = (sums[:, :-1] / sums[:, -1:]).chunk(2, dim=1)
    return (square - mean.square()).clamp(min=0)
