"""Temporal accumulation: noisy irradiance averaged over frames along motion vectors (SVGF §4.1)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from models.reprojection import reproject
from models.surfaces import Surfaces

SMALLEST_ALPHA = 0.2


@dataclass(frozen=True)
class Accumulation:
    """History of accumulation: irradiance (B, 3, H, W), its length in frames (B, 1, H, W), and the G-buffer."""

    irradiance: Tensor
    length: Tensor
    surfaces: Surfaces


def accumulate(frame: Frame, irradiance: Tensor, history: Accumulation | None) -> Accumulation:
    """Blend noisy `irradiance` (B, 3, H, W) into its history with weight alpha = max(0.2, 1 / (n + 1)).

    n is the history's length, so the first five frames are averaged evenly; then it is an exponential moving average.
    Disoccluded pixels start anew.
    """
    length = torch.ones_like(irradiance[:, :1])
    if history is not None:
        past, found = reproject(frame, torch.cat([history.irradiance, history.length], dim=1), history.surfaces)
        n = past[:, 3:]
        alpha = torch.where(found, (1 / (n + 1)).clamp(min=SMALLEST_ALPHA), 1)
        irradiance = torch.lerp(past[:, :3], irradiance, alpha)
        length = torch.where(found, n + 1, 1)
    return Accumulation(irradiance, length, Surfaces.of(frame))
