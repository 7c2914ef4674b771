"""A loss for noisy references: the error as displayed and how it changes from frame to frame, at several scales."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.features import GAMMA
from models.denoiser import Denoiser
from train.crops import Crops
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean
from train.losses.outputs import exposed_outputs
from train.sequences import Batch

DARKEST = 1e-4  # exposed radiance, below which the curve is no steeper


def cut_tone(radiance: Tensor) -> Tensor:
    """Exposed radiance as a display shows it, about in [0, 1]; what is brighter than white is cut."""
    return (radiance.clamp(0, 1) + DARKEST) ** (1 / GAMMA)


def tone(radiance: Tensor) -> Tensor:
    """The same, but what is brighter than white goes on as its logarithm."""
    return cut_tone(radiance) + torch.log(radiance.clamp(min=1)) / GAMMA


def shrunk(radiance: Tensor, surface: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """The means over the surfaces in blocks of scale x scale pixels (B, 3, h, w), and where there are any."""
    if scale == 1:
        return radiance, surface
    share = F.avg_pool2d(surface, scale, ceil_mode=True)
    mean = F.avg_pool2d(radiance * surface, scale, ceil_mode=True)
    return mean / share.clamp(min=1e-6), share


def sum_of_scales(errors: Sequence[Tensor], shares: Sequence[Tensor]) -> Tensor:
    """The sum of the mean absolute values of errors where there are surfaces."""
    return torch.stack([surface_mean(error.abs(), share) for error, share in zip(errors, shares, strict=True)]).sum()


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
    """L1 of what is displayed, and of its changes, at each scale. For any network, which sets the exposure."""

    def __init__(self, denoiser: Denoiser, terms: DisplayedTerms | None = None):
        super().__init__()
        self.denoiser = denoiser
        self.terms = terms or DisplayedTerms()

    def errors(self, output: Tensor, target: Tensor, surface: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Output minus target (B, 3, H, W) as displayed, 0 off surfaces; where these are: in blocks of each scale."""
        found = []
        for scale in self.terms.scales:
            shown, share = shrunk(output, surface, scale)
            error = tone(shown) - tone(shrunk(target, surface, scale)[0])
            found.append((torch.where(share > 0, error, 0), share))
        return found

    def forward(self, batch: Batch | Crops) -> tuple[Tensor, Parts]:
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        before: Sequence[Tensor] = ()  # the last frame's errors
        for frame, output, exposure in exposed_outputs(self.denoiser, batch):
            target = exposure * frame.reference_buffers(self.denoiser.signal).mean(dim=1)
            errors, shares = zip(*self.errors(output, target, (frame.depth > 0).to(output)), strict=True)
            spatial.append(sum_of_scales(errors, shares))
            if before:
                temporal.append(sum_of_scales([now - then for now, then in zip(errors, before, strict=True)], shares))
            before = errors
        parts = {"spatial": torch.stack(spatial).mean()}
        loss = parts["spatial"]
        if temporal:
            parts["temporal"] = torch.stack(temporal).mean()
            loss = loss + self.terms.temporal * parts["temporal"]
        return loss, {name: part.detach() for name, part in parts.items()}
