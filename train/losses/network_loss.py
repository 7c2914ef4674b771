"""What all losses have in common: each is a module around the network it trains, so that one loop serves all."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from models.denoiser import Denoiser

Parts = dict[str, Tensor]  # of a loss by name: scalars, detached, to display


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
