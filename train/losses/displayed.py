"""A loss for noisy references: the error as displayed, at several scales, and how it changes from frame to frame."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.sequences import Batch
from models.denoiser import Denoiser
from models.parameters import GAMMA
from train.crops import Crops
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean
from train.losses.outputs import exposed_outputs

DARKEST = 1e-4  # exposed radiance, below which the curve is no steeper


def tone(radiance: Tensor) -> Tensor:
    """Exposed radiance as a display shows it, about in [0, 1]; what is brighter than white goes on as its logarithm."""
    shown = (radiance.clamp(0, 1) + DARKEST) ** (1 / GAMMA)
    return shown + torch.log(radiance.clamp(min=1)) / GAMMA


def shrunk(radiance: Tensor, surface: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """The means over the surfaces in blocks of scale x scale pixels (B, 3, h, w), and where there are any."""
    if scale == 1:
        return radiance, surface
    share = F.avg_pool2d(surface, scale, ceil_mode=True)
    mean = F.avg_pool2d(radiance * surface, scale, ceil_mode=True)
    return mean / share.clamp(min=1e-6), share


@dataclass(frozen=True)
class DisplayedTerms(LossTerms):
    """The weight of what changes, and the scales in pixels, the first of them 1.

    A network that is only compared pixel by pixel to noisy references learns their median, which is too dark where
    light is rare. Means over blocks have hardly any noise left: they keep the energy, and they are where blotches show.
    """

    temporal: float = 0.25  # where there are sequences
    scales: tuple[int, ...] = (1, 4, 16)

    def around(self, denoiser: Denoiser) -> "DisplayedLoss":
        return DisplayedLoss(denoiser, self)


class DisplayedLoss(NetworkLoss):
    """L1 of what is displayed: of each scale, and of changes. For any network, which sets the exposure."""

    def __init__(self, denoiser: Denoiser, terms: DisplayedTerms | None = None):
        super().__init__()
        self.denoiser = denoiser
        self.terms = terms or DisplayedTerms()

    def errors(self, output: Tensor, target: Tensor, surface: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Output minus target (B, 3, H, W) as displayed, and where there are surfaces, in blocks of each scale."""
        found = []
        for scale in self.terms.scales:
            shown, share = shrunk(output, surface, scale)
            found.append((tone(shown) - tone(shrunk(target, surface, scale)[0]), share))
        return found

    def forward(self, batch: Batch | Crops) -> tuple[Tensor, Parts]:
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        before: Tensor | None = None  # the last frame's error of single pixels
        for frame, output, exposure in exposed_outputs(self.denoiser, batch):
            target = exposure * frame.reference_halves(self.denoiser.signal).mean(dim=1)
            errors = self.errors(output, target, (frame.depth > 0).to(output))
            spatial.append(torch.stack([surface_mean(error.abs(), share) for error, share in errors]).sum())
            error = torch.where(frame.depth > 0, errors[0][0], 0)
            if before is not None:
                temporal.append(surface_mean((error - before).abs(), frame.depth))
            before = error
        parts = {"spatial": torch.stack(spatial).mean()}
        loss = parts["spatial"]
        if temporal:
            parts["temporal"] = torch.stack(temporal).mean()
            loss = loss + self.terms.temporal * parts["temporal"]
        return loss, {name: part.detach() for name, part in parts.items()}
