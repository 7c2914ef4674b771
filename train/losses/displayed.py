"""A loss for noisy references: the error as displayed and how it changes from frame to frame, at several scales."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import Frame
from datasets.tonemap import DISPLAY_GAMMA
from models.denoiser import Denoiser
from train.crops import AnyBatch
from train.losses.network_loss import Loss, Parts, exposed_outputs, surface_mean
from train.sequences import Batch

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


def sum_of_scales(errors: Sequence[Tensor], shares: Sequence[Tensor]) -> Tensor:
    """The sum of the mean absolute values of errors where there are surfaces."""
    return torch.stack([surface_mean(error.abs(), share) for error, share in zip(errors, shares, strict=True)]).sum()


@dataclass(frozen=True)
class DisplayedLoss(Loss):
    """L1 of what is displayed, and of its changes, at each scale. For any network, which sets the exposure.

    A network that is only compared pixel by pixel to noisy references learns their median, which is too dark where
    light is rare. Means over blocks have hardly any noise left: they keep the energy, and they are where blotches show.
    """

    temporal: float = 0.25  # weight of what changes, where there are sequences
    scales: tuple[int, ...] = (1, 4, 16)  # pixels, the first of them 1
    squared: float = 0.0  # weight of the squared errors of pixels, clipped at white: their optimum is the mean
    first: float = 1.0  # weight of frames without history, where there are any beside the sequences

    def errors(self, output: Tensor, target: Tensor, surface: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Output minus target (B, 3, H, W) as displayed, 0 off surfaces, and their share in blocks of each scale."""
        errors = []
        for scale in self.scales:
            mean, share = block_means(output, surface, scale)
            error = tone(mean) - tone(block_means(target, surface, scale)[0])
            errors.append((torch.where(share > 0, error, 0), share))
        return errors

    def frame_loss(
        self, network: Denoiser, frame: Frame, output: Tensor, exposure: Tensor
    ) -> tuple[Tensor, Sequence[Tensor], Sequence[Tensor]]:
        """The loss of one frame's output; its errors and the share of surfaces at each scale."""
        target = exposure * frame.reference_buffers(network.signal).mean(dim=1)
        errors, shares = zip(*self.errors(output, target, (frame.depth > 0).to(output)), strict=True)
        loss = sum_of_scales(errors, shares)
        if self.squared:
            error = clipped_tone(output) - clipped_tone(target)
            loss = loss + self.squared * surface_mean(error.square(), shares[0])
        return loss, errors, shares

    def compute(self, network: Denoiser, batch: AnyBatch, progress: float) -> tuple[Tensor, Parts]:
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        before: Sequence[Tensor] = ()  # the last frame's errors
        for frame, output, exposure in exposed_outputs(network, batch):
            of_frame, errors, shares = self.frame_loss(network, frame, output, exposure)
            spatial.append(of_frame)
            if before:
                temporal.append(sum_of_scales([now - then for now, then in zip(errors, before, strict=True)], shares))
            before = errors
        parts = {"spatial": torch.stack(spatial).mean()}
        loss = parts["spatial"]
        if temporal:
            parts["temporal"] = torch.stack(temporal).mean()
            loss = loss + self.temporal * parts["temporal"]
        if isinstance(batch, Batch) and batch.firsts is not None:
            (alone,) = exposed_outputs(network, Batch([batch.firsts]))
            parts["first"], _, _ = self.frame_loss(network, *alone)
            loss = loss + self.first * parts["first"]
        return loss, parts
