"""What all losses have in common: the trainer runs each as one module with the network, so that one loop serves all."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from datasets.frame import Frame
from models.denoiser import Denoiser
from models.history.running_scale import RunningScale
from train.crops import AnyBatch, Crops
from train.protocols import FilteringNetwork, RecurrentNetwork, ScaledState
from train.sequences import Batch

Parts = dict[str, Tensor]  # of a loss by name: scalars, to display


@dataclass(frozen=True)
class Loss:
    """A loss with its parameters, as a recipe states them."""

    def compute(self, network: Denoiser, batch: AnyBatch, progress: float) -> tuple[Tensor, Parts]:
        """The loss to back-propagate (a scalar), through time where there are sequences, and its parts.

        `progress` is the share of the training that is done, 0 to 1; it is 1 in validation.
        """
        raise NotImplementedError


class NetworkLoss(nn.Module):
    """A loss and the network that it trains; forward(batch) returns what `Loss.compute` does, the parts detached."""

    def __init__(self, denoiser: Denoiser, loss: Loss):
        super().__init__()
        self.denoiser = denoiser
        self.loss = loss
        self.progress = 0.0

    def forward(self, batch: AnyBatch) -> tuple[Tensor, Parts]:
        loss, parts = self.loss.compute(self.denoiser, batch, self.progress if self.training else 1.0)
        return loss, {name: part.detach() for name, part in parts.items()}


def surface_mean(values: Tensor, depth: Tensor) -> Tensor:
    """Mean of `values` (B, C, H, W) over the pixels that show a surface; each item of the batch counts the same.

    The background (`depth` 0) is not for networks to learn, and its zeros would thin the mean out. Where an item shows
    no surface, its mean is 0. So the mean of a batch is that of its parts' means, however it is divided.
    """
    surface = depth > 0
    total = torch.where(surface, values, 0).sum(dim=(1, 2, 3))
    return (total / (values.shape[1] * surface.sum(dim=(1, 2, 3))).clamp(min=1)).mean()


def predictions(network: RecurrentNetwork, batch: AnyBatch) -> Iterator[tuple[Frame, Tensor, RunningScale]]:
    """Each frame of a batch of sequences with what the network predicts, and the running scale there."""
    assert isinstance(batch, Batch)
    state: ScaledState | None = None
    for frame in batch.frames:
        prediction, state = network.predict(frame, state)
        yield frame, prediction, state.scale


def exposed_outputs(network: Denoiser, batch: AnyBatch) -> Iterator[tuple[Frame, Tensor, Tensor]]:
    """Each frame, the radiance (B, 3, H, W) that surfaces reflect by the network, exposed, and the exposure.

    The exposure (B, 1 or 3, 1, 1) includes the gain. Emission is left out. What the network returns may be below 0.
    """
    if isinstance(batch, Crops):
        assert isinstance(network, FilteringNetwork)
        frame, exposure = batch.frame, batch.scale.exposure() * batch.frame.gain
        irradiance, _ = network.filter(frame, batch.irradiance, batch.scale)
        yield frame, exposure * irradiance * frame.divisor, exposure
        return
    assert isinstance(network, RecurrentNetwork)
    for frame, prediction, scale in predictions(network, batch):
        exposure = scale.exposure() * frame.gain
        yield frame, network.exposed(prediction, exposure) * frame.divisor, exposure
