"""The loss of `one`: each frame's relative error, and that of its change from the frame before."""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.sequences import Batch
from models.denoiser import Denoiser, State
from models.one import One
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean
from train.losses.wskp import smape


@dataclass(frozen=True)
class OneTerms(LossTerms):
    """Weights of its parts. Radiance is scaled by the causal exposure, so that epsilon means the same in any light."""

    temporal: float = 0.25
    epsilon: float = 0.01

    def around(self, denoiser: Denoiser) -> "OneLoss":
        assert isinstance(denoiser, One)
        return OneLoss(denoiser, self)


class OneLoss(NetworkLoss):
    """SMAPE of each frame plus that of changes, relative to the brightness of both frames; means over frames."""

    def __init__(self, denoiser: One, terms: OneTerms | None = None):
        super().__init__()
        self.denoiser: One = denoiser
        self.terms = terms or OneTerms()

    def forward(self, batch: Batch) -> tuple[Tensor, Parts]:
        denoiser = self.denoiser
        epsilon = self.terms.epsilon
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        state: State | None = None
        before: tuple[Tensor, Tensor] | None = None  # (output, target) of the frame before
        for frame in batch.frames:
            irradiance, state = denoiser.predict(frame, state)
            exposure = state.scale.exposure() * frame.gain
            images = (irradiance, frame.reference_irradiance(denoiser.signal))
            output, target = (exposure * image * frame.divisor for image in images)
            spatial.append(surface_mean(smape(output, target, epsilon), frame.depth))
            if before is not None:
                change = (output - before[0]) - (target - before[1])
                relative = change.abs() / (output.detach() + target + epsilon)
                temporal.append(surface_mean(relative, frame.depth))
            before = (output, target)
        parts = {"spatial": torch.stack(spatial).mean(), "temporal": torch.stack(temporal).mean()}
        loss = parts["spatial"] + self.terms.temporal * parts["temporal"]
        return loss, {name: part.detach() for name, part in parts.items()}
