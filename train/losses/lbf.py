"""The loss of LBF."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.denoiser import Denoiser
from train.crops import AnyBatch
from train.losses.network_loss import Loss, Parts, exposed_outputs, surface_mean


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
