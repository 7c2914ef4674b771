"""Temporal accumulation: noisy irradiance averaged over frames along motion vectors (SVGF §4.1)."""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.frame import Frame
from models import compiled
from models.compiled import accumulation as kernels
from models.compiled.accumulation import MIN_ALPHA
from models.history.geometry import GBuffer
from models.history.reprojection import reproject


@dataclass(frozen=True)
class Accumulation:
    """Accumulated irradiance (B, 3, H, W), its history length in frames (B, 1, H, W), and the frame's G-buffer."""

    irradiance: Tensor
    length: Tensor
    gbuffer: GBuffer


@compiled.by(kernels.accumulate_samples)
def accumulate_samples(
    frame: Frame, noisy: Tensor, past_irradiance: Tensor, past_length: Tensor, gbuffer: GBuffer
) -> tuple[Tensor, Tensor]:
    """`accumulate` where there is a previous frame, with `gbuffer`: irradiance (B, 3, H, W), length (B, 1, H, W)."""
    history, has_history = reproject(frame, torch.cat([past_irradiance, past_length], dim=1), gbuffer)
    length = history[:, 3:] + 1
    alpha = torch.where(has_history, (1 / length).clamp(min=MIN_ALPHA), 1)
    return torch.lerp(history[:, :3], noisy, alpha), torch.where(has_history, length, 1)


def accumulate(frame: Frame, irradiance: Tensor, previous: Accumulation | None) -> Accumulation:
    """Blend noisy `irradiance` (B, 3, H, W) into its history with weight alpha = max(0.2, 1 / (n + 1)).

    n is the length of the history: the first five frames are averaged evenly, later ones exponentially. Disoccluded
    pixels start anew.
    """
    length = torch.ones_like(irradiance[:, :1])
    if previous is not None:
        past = previous.irradiance, previous.length, previous.gbuffer
        irradiance, length = accumulate_samples(frame, irradiance, *past)
    return Accumulation(irradiance, length, GBuffer.of(frame))
