"""What all losses have in common: each is a module around the network it trains, so that one loop serves all."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from models.denoiser import Denoiser

Parts = dict[str, Tensor]  # of a loss by name: scalars, detached, to display


def surface_mean(values: Tensor, depth: Tensor) -> Tensor:
    """Mean of `values` (B, C, H, W) over the pixels that show a surface; each item of the batch counts the same.

    The background (`depth` 0) is not for networks to learn, and its zeros would thin the mean out. Where an item shows
    no surface, its mean is 0. So the mean of a batch is that of its parts' means, however it is divided.
    """
    surface = depth > 0
    total = torch.where(surface, values, 0).sum(dim=(1, 2, 3))
    return (total / (values.shape[1] * surface.sum(dim=(1, 2, 3))).clamp(min=1)).mean()


class NetworkLoss(nn.Module):
    """Runs a network over a batch and returns the loss to back-propagate, through time where there are sequences.

    forward(batch) returns the loss (scalar) and its parts. `progress` is how far the training has come, 0 to 1.
    """

    denoiser: Denoiser
    progress: float = 0.0

    def forward(self, batch: Any) -> tuple[Tensor, Parts]:
        raise NotImplementedError


@dataclass(frozen=True)
class LossTerms:
    """The parameters of a loss: what a recipe says of it."""

    def around(self, denoiser: Denoiser) -> NetworkLoss:
        """The loss with these parameters around the network that it trains."""
        raise NotImplementedError
