"""Temporal accumulation: noisy irradiance averaged over frames along motion vectors (SVGF §4.1)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from models import compiled
from models.compiled import accumulation as kernels
from models.compiled.accumulation import MIN_ALPHA
from models.history.reprojection import reproject
from models.history.surfaces import Surfaces


@dataclass(frozen=True)
class Accumulation:
    """History of accumulation: irradiance (B, 3, H, W), its length in frames (B, 1, H, W), and the G-buffer."""

    irradiance: Tensor
    length: Tensor
    surfaces: Surfaces


@compiled.by(kernels.accumulate_samples)
def accumulate_samples(
    frame: Frame, noisy: Tensor, past_irradiance: Tensor, past_length: Tensor, surfaces: Surfaces
) -> tuple[Tensor, Tensor]:
    """`accumulate` with a history: irradiance (B, 3, H, W) and length (B, 1, H, W); `surfaces` are the history's."""
    past, found = reproject(frame, torch.cat([past_irradiance, past_length], dim=1), surfaces)
    length = past[:, 3:] + 1
    alpha = (1 / length).clamp(min=MIN_ALPHA)
    return torch.lerp(past[:, :3], noisy, torch.where(found, alpha, 1)), torch.where(found, length, 1)


def accumulate(frame: Frame, irradiance: Tensor, history: Accumulation | None) -> Accumulation:
    """Blend noisy `irradiance` (B, 3, H, W) into its history with weight alpha = max(0.2, 1 / (n + 1)).

    n is the history's length, so the first five frames are averaged evenly; then it is an exponential moving average.
    Disoccluded pixels start anew.
    """
    length = torch.ones_like(irradiance[:, :1])
    if history is not None:
        past = history.irradiance, history.length, history.surfaces
        irradiance, length = accumulate_samples(frame, irradiance, *past)
    return Accumulation(irradiance, length, Surfaces.of(frame))
