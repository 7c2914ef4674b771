"""A-SVGF: SVGF whose history gives way where light changes (Schied et al. 2018).

"Gradient Estimation for Real-Time Adaptive Temporal Filtering". The renderer says how light changes: the channel
`gradient` (render/gradient.py). From memory of the paper; where that, or the paper, is silent, we choose:

- The edge-avoiding filter of gradients (§4.3) has SVGF's kernel and its weights of depth and normal, and none of
  luminance, which one sample a stratum does not know.
- A stratum's geometry is that of its sample; several samples in one count together, none counts nothing.
- The history's length, which decides when a spatial estimate stands in for temporal variance, shrinks by 1 - λ as well.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from models.atrous import CENTRE, RADIUS, WindowSum, b3_spline, strip_taps
from models.svgf import SVGF, geometry_weight, pack_geometry

STRATUM = 3  # px, see render/gradient.py
LEVELS = 5
DARKEST = 1e-30  # luminance that λ does not divide by


def geometry_of_strata(frame: Frame, brightest: Tensor) -> Tensor:
    """What stops the filter at edges (see pack_geometry), of the sample in each stratum, (B, 1, 7, h, w).

    `brightest` (B, 1, H, W) is the larger luminance of each sample, 0 where there is none.
    """
    _, index = F.max_pool2d(brightest, STRATUM, ceil_mode=True, return_indices=True)

    def picked(channel: Tensor) -> Tensor:
        return channel.flatten(2).gather(2, index.flatten(2).expand(-1, channel.shape[1], -1)).unflatten(
            2, index.shape[-2:]
        )

    return pack_geometry(picked(frame.depth), picked(frame.normal), picked(frame.mesh_id))


def gradient_level(gradient: Tensor, geometry: Tensor, step: int) -> Tensor:
    """One level of the à-trous transform (§4.3) of gradients (B, 1, 2, h, w). Taps are `step` strata apart."""
    total = WindowSum(torch.ones_like(gradient[:, :, :1]), CENTRE)
    mean = WindowSum(gradient, CENTRE)
    for tap in strip_taps(gradient.shape[-2:], RADIUS, step):
        weight = geometry_weight(geometry[tap.p], geometry[tap.q], tap.dx, tap.dy).mul_(b3_spline(tap, step))
        total.add(tap, weight)
        mean.add(tap, weight)
    return mean.sum / total.sum


def change_of_light(frame: Frame) -> Tensor:
    """λ = min(1, |δ| / Δ) with both filtered (§4.3, §4.4): how much light has changed, (B, 1, H, W) in [0, 1]."""
    height, width = frame.size
    gradient = F.avg_pool2d(frame.gradient, STRATUM, ceil_mode=True, divisor_override=1)[:, None]
    geometry = geometry_of_strata(frame, frame.gradient[:, 1:])
    for level in range(LEVELS):
        gradient = gradient_level(gradient, geometry, 2**level)
    difference, largest = gradient[:, 0].split(1, dim=1)
    share = (difference.abs() / largest.clamp(min=DARKEST)).clamp(max=1)
    full = share.repeat_interleave(STRATUM, dim=-2).repeat_interleave(STRATUM, dim=-1)
    return full[..., :height, :width]


class ASVGF(SVGF):
    """SVGF with α = (1 - λ) 0.2 + λ for colour and moments alike (§4.4)."""

    reads = (*SVGF.reads, "gradient")

    def change(self, frame: Frame) -> Tensor:
        return change_of_light(frame)
