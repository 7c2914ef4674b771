"""The loss of LBF."""

from dataclasses import dataclass

import torch
from torch import Tensor

from models.denoiser import Denoiser
from models.networks.lbf import LBF
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean
from train.losses.outputs import exposed_outputs
from train.sequences import Batch


@dataclass(frozen=True)
class LBFTerms(LossTerms):
    """The parameter of the loss of LBF."""

    epsilon: float = 0.01  # of squared exposed radiance

    def around(self, denoiser: Denoiser) -> "LBFLoss":
        assert isinstance(denoiser, LBF)
        return LBFLoss(denoiser, self)


class LBFLoss(NetworkLoss):
    """The relative MSE (Rousselle et al. 2011) of exposed radiance, n / 2 (c - r)² / (r² + epsilon).

    c is the output, r the reference, emission included. As squared errors are inversely proportional to the number n
    of samples a pixel, all numbers count alike. Spikes are not removed in training: a median teaches nothing.
    """

    def __init__(self, denoiser: LBF, terms: LBFTerms | None = None):
        super().__init__()
        self.denoiser: LBF = denoiser
        self.terms = terms or LBFTerms()

    def forward(self, batch: Batch) -> tuple[Tensor, Parts]:
        signal = self.denoiser.signal
        losses = []
        for frame, output, exposure in exposed_outputs(self.denoiser, batch):
            reference = exposure * frame.reference_buffers(signal).mean(dim=1)
            shown = reference + exposure * frame.emission if signal == "total" else reference
            error = (output - reference).square() / (shown.square() + self.terms.epsilon)
            losses.append(surface_mean(frame.samples / 2 * error, frame.depth))
        return torch.stack(losses).mean(), {}
