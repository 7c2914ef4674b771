"""Sums over neighbours (filters/neighbours.py, networks/affinity.py) in few operators: taps are slices, all in one tensor.

Slices are exact in every engine; convolutions round meshes and bright pixels where engines shorten their inputs.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.affinity import MIN_LOGIT
from models.operators import MIN_DIVISOR


def around(x: Tensor, step: int) -> Tensor:
    """The 3 x 3 taps `step` pixels apart of (1, C, H, W) but the middle one: (8, C, H, W), 0 outside the image."""
    padded = F.pad(x, (step, step, step, step))
    shifts = (slice(None, -2 * step), slice(step, -step), slice(2 * step, None))  # constants for images of any size
    rows = [padded[:, :, shift] for shift in shifts]
    taps = [row[..., shift] for row in rows for shift in shifts]
    return torch.cat(taps[:4] + taps[5:])


def mesh_sums(image: Tensor, mesh: Tensor, step: int) -> Tensor:
    """See models.filters.neighbours.mesh_sums. `mesh` (1, 1, H, W) is nowhere 0."""
    values, meshes = around(torch.cat([image, mesh], dim=1), step).split([image.shape[1], 1], dim=1)
    return image + torch.where(meshes == mesh, values, 0).sum(dim=0, keepdim=True)


def affinity_level(
    image: Tensor, features: Tensor, sharpness: Tensor, own: Tensor, importance: Tensor, surface: Tensor, step: int
) -> Tensor:
    """See models.networks.affinity.affinity_level; `image` is 0 for background."""
    values = torch.cat([image, surface], dim=1)
    difference = around(features, step) - features
    distance = (difference * difference).sum(dim=1, keepdim=True)
    importances, near = around(torch.cat([importance, values], dim=1), step).split([1, 4], dim=1)
    weight = torch.exp((importances - sharpness * distance).clamp(min=MIN_LOGIT))
    total = (weight * near).sum(dim=0, keepdim=True) + torch.exp(own) * values
    weighted, weights = total.split([3, 1], dim=1)
    return torch.where(surface > 0, weighted / weights.clamp(min=MIN_DIVISOR), 0)
