"""A loss for noisy references: the error as displayed and how it changes from frame to frame, at several scales."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.tonemap import DISPLAY_GAMMA
from models.denoiser import Denoiser
from train.crops import AnyBatch
from train.losses.network_loss import Loss, Parts, exposed_outputs, surface_mean

NOISE = 0.01  # squared, of the displayed reference that counts half
TONE_OFFSET = 1e-4  # of exposed radiance: it bounds the slope of the curve at black


def clipped_tone(radiance: Tensor) -> Tensor:
    """Exposed radiance as a display shows it, about in [0, 1]; what is brighter than white is clipped."""
    return (radiance.clamp(0, 1) + TONE_OFFSET) ** (1 / DISPLAY_GAMMA)


def tone(radiance: Tensor) -> Tensor:
    """The same, but radiance above white continues as its logarithm."""
    return clipped_tone(radiance) + torch.log(radiance.clamp(min=1)) / DISPLAY_GAMMA


def block_means(radiance: Tensor, surface: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """The means over the surfaces in blocks of scale x scale pixels (B, 3, h, w), and the share of surfaces there."""
    if scale == 1:
        return radiance, surface
    share = F.avg_pool2d(surface, scale, ceil_mode=True)
    mean = F.avg_pool2d(radiance * surface, scale, ceil_mode=True)
    return mean / share.clamp(min=1e-6), share


def cost(error: Tensor, squared: float) -> Tensor:
    """|e| + squared · c² (B, 3, H, W) of errors (B, 6, H, W): e, and c with what is brighter than white clipped."""
    unclipped, clipped = error.chunk(2, dim=1)
    return unclipped.abs() + squared * clipped.square()


def sum_of_scales(costs: Sequence[Tensor], shares: Sequence[Tensor]) -> Tensor:
    """The sum over scales of the mean cost where there are surfaces."""
    return torch.stack([surface_mean(cost, share) for cost, share in zip(costs, shares, strict=True)]).sum()


def reliability(buffers: Tensor, surface: Tensor) -> Tensor:
    """NOISE / (NOISE + the mean squared noise as displayed) of references, whose exposed `buffers` are (B, 2, 3, H, W).

    (B, 1, 1, 1), near 1 for usual references. Where light is too rare for them, all that could be learnt is noise.
    """
    a, b = clipped_tone(buffers).unbind(dim=1)
    noise = ((a - b) / 2).square() * surface
    share = surface.mean(dim=(1, 2, 3), keepdim=True).clamp(min=1e-6)
    return NOISE / (NOISE + noise.mean(dim=(1, 2, 3), keepdim=True) / share)


@dataclass(frozen=True)
class DisplayedLoss(Loss):
    """The error of what is displayed, and of its changes, at each scale. For any network, which sets the exposure.

    A network that is only compared pixel by pixel to noisy references learns their median, which is too dark where
    light is rare. Means over blocks have hardly any noise left: they keep the energy, and they are where blotches show.
    Squares, whose optimum is the mean, add weight to large errors, as PSNR does, and like it they clip what is brighter
    than white: of dark close-ups a few highlights would outweigh all else.
    """

    temporal: float = 0.25  # weight of what changes, where there are sequences
    scales: tuple[int, ...] = (1, 4, 16)  # pixels, the first of them 1
    squared: float = 0.0  # weight of squared errors

    def errors(self, output: Tensor, target: Tensor, surface: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Output minus target (B, 6, H, W): tone and clipped_tone, 0 off surfaces, and their share, at each scale."""
        errors = []
        for scale in self.scales:
            mean, share = block_means(output, surface, scale)
            truth = block_means(target, surface, scale)[0]
            error = torch.cat([curve(mean) - curve(truth) for curve in (tone, clipped_tone)], dim=1)
            errors.append((torch.where(share > 0, error, 0), share))
        return errors

    def compute(self, network: Denoiser, batch: AnyBatch, progress: float) -> tuple[Tensor, Parts]:
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        before: Sequence[Tensor] = ()  # the last frame's errors
        for frame, output, exposure in exposed_outputs(network, batch):
            buffers = exposure[:, None] * frame.reference_buffers(network.signal)
            surface = (frame.depth > 0).to(output)
            weight = reliability(buffers, surface)
            errors, shares = zip(*self.errors(output, buffers.mean(dim=1), surface), strict=True)
            spatial.append(sum_of_scales([weight * cost(error, self.squared) for error in errors], shares))
            if before:
                changes = (now - then for now, then in zip(errors, before, strict=True))
                temporal.append(sum_of_scales([weight * cost(change, self.squared) for change in changes], shares))
            before = errors
        parts = {"spatial": torch.stack(spatial).mean()}
        loss = parts["spatial"]
        if temporal:
            parts["temporal"] = torch.stack(temporal).mean()
            loss = loss + self.temporal * parts["temporal"]
        return loss, parts
