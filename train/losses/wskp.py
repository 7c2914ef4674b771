"""The losses of networks that filter accumulated crops: those of WSKP, NBGD and LBF."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.denoiser import Denoiser
from train.crops import AnyBatch, Crops
from train.losses.displayed import clipped_tone
from train.losses.network_loss import Loss, Parts, exposed_outputs, surface_mean
from train.protocols import FilteringNetwork


@dataclass(frozen=True)
class CropLoss(Loss):
    """The mean `error` of radiance, emission included, scaled by the causal exposure."""

    def error(self, output: Tensor, reference: Tensor) -> Tensor:
        """Of every pixel and channel (B, 3, H, W), of exposed radiance."""
        raise NotImplementedError

    def compute(self, network: Denoiser, batch: AnyBatch, progress: float) -> tuple[Tensor, Parts]:
        assert isinstance(network, FilteringNetwork) and isinstance(batch, Crops)
        frame = batch.frame
        filtered, _ = network.filter(frame, batch.irradiance, batch.scale)
        exposure = batch.scale.exposure()
        images = (filtered, frame.reference_irradiance(network.signal))
        output, reference = (exposure * frame.remodulate(image, network.signal) for image in images)
        return surface_mean(self.error(output, reference), frame.depth), {}


@dataclass(frozen=True)
class SMAPELoss(CropLoss):
    """SMAPE of HDR radiance (WSKP §5.2). By the exposure, epsilon means the same in whatever units are used."""

    epsilon: float = 0.01

    def error(self, output: Tensor, reference: Tensor) -> Tensor:
        """|x - r| / (|x| + |r| + epsilon) (WSKP Eq. 6), in [0, 1)."""
        return (output - reference).abs() / (output.abs() + reference.abs() + self.epsilon)


@dataclass(frozen=True)
class NBGDLoss(CropLoss):
    """L1 of radiance as displayed, clipped at white (Meng et al. 2020), whose authors' renderings come exposed."""

    def error(self, output: Tensor, reference: Tensor) -> Tensor:
        return (clipped_tone(output) - clipped_tone(reference)).abs()


@dataclass(frozen=True)
class LBFLoss(Loss):
    """The relative MSE (Rousselle et al. 2011) of exposed radiance, n / 2 (c - r)² / (r² + epsilon).

    c is the output, r the reference, emission included. As squared errors are inversely proportional to the number n
    of samples per pixel, all numbers count alike. Spikes are not removed in training: a median teaches nothing.
    """

    epsilon: float = 0.01  # of squared exposed radiance

    def compute(self, network: Denoiser, batch: AnyBatch, progress: float) -> tuple[Tensor, Parts]:
        losses = []
        for frame, output, exposure in exposed_outputs(network, batch):
            reference = exposure * frame.reference_buffers(network.signal).mean(dim=1)
            shown = reference + exposure * frame.emission if network.signal == "total" else reference
            error = (output - reference).square() / (shown.square() + self.epsilon)
            losses.append(surface_mean(frame.samples / 2 * error, frame.depth))
        return torch.stack(losses).mean(), {}
