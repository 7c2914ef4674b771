"""The pixels around each pixel, some steps apart."""

import torch
from torch import Tensor
from torch.nn import functional as F

from models import compiled
from models.compiled import neighbours as kernels


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
