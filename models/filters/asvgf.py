"""A-SVGF: SVGF whose history gives way where light changes (Schied et al. 2018).

"Gradient Estimation for Real-Time Adaptive Temporal Filtering". The renderer says how light changes: the channel
`gradient` (render/gradient.py). Where the paper is silent, or we do not have its words, we choose:

- The edge-avoiding filter of gradients has SVGF's kernel, five levels, and SVGF's weights of depth and normal; none of
  luminance, whose variance one sample a stratum does not tell.
- A stratum's geometry is that of its sample; several samples in one count together, none counts nothing.
- The history's length, which decides when a spatial estimate stands in for temporal variance, shrinks by 1 - λ as well.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models.filters.atrous import ATROUS_LEVELS, CENTRE, RADIUS, WindowSum, b3_spline, strip_taps
from models.filters.svgf import SVGF, geometry_weight, pack_geometry
from models.history.strata import STRATUM, repeated, sums
from models.operators import MIN_DIVISOR


def geometry_of_samples(frame: Frame) -> Tensor:
    """What stops the filter at edges (see pack_geometry), of the brightest sample in each stratum, (B, 7, h, w)."""
    _, index = F.max_pool2d(frame.gradient[:, 1:], STRATUM, ceil_mode=True, return_indices=True)

    def picked(channel: Tensor) -> Tensor:
        places = index.flatten(2).expand(-1, channel.shape[1], -1)
        return channel.flatten(2).gather(2, places).unflatten(2, index.shape[-2:])

    return pack_geometry(picked(frame.depth), picked(frame.normal), picked(frame.mesh_id))[:, 0]


def gradient_level(gradient: Tensor, geometry: Tensor, step: int) -> Tensor:
    """One level of the à-trous transform of gradients (B, 2, h, w) within `geometry`. Taps are `step` strata apart."""
    total = WindowSum(torch.ones_like(gradient[:, :1]), CENTRE)
    mean = WindowSum(gradient, CENTRE)
    for tap in strip_taps(gradient.shape[-2:], RADIUS, step):
        weight = geometry_weight(geometry[tap.p], geometry[tap.q], tap.dx, tap.dy).mul_(b3_spline(tap, step))
        total.add(tap, weight)
        mean.add(tap, weight)
    return mean.sum / total.sum


def change_of_light(frame: Frame) -> Tensor:
    """How much light has changed, (B, 1, H, W): λ = min(1, |δ| / Δ) of filtered differences and largest luminances."""
    gradient = sums(frame.gradient)
    geometry = geometry_of_samples(frame)
    for level in range(ATROUS_LEVELS):
        gradient = gradient_level(gradient, geometry, 2**level)
    difference, largest = gradient.split(1, dim=1)
    return repeated((difference.abs() / largest.clamp(min=MIN_DIVISOR)).clamp(max=1), frame.size)


class ASVGF(SVGF):
    """SVGF with α = (1 - λ) 0.2 + λ, for colour and moments alike."""

    reads: tuple[str, ...] = (*SVGF.reads, "gradient")
    baseline_for = ()

    def change(self, frame: Frame) -> Tensor:
        return change_of_light(frame)
