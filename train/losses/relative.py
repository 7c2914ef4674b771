"""The relative squared error, whose best network is right on the mean of noisy targets."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from datasets.frame import Frame
from datasets.sequences import Batch
from models.denoiser import Denoiser
from models.rae import POWER, RAE
from models.running_scale import RunningScale
from train.crops import Crops
from train.losses.network_loss import LossTerms, NetworkLoss, Parts, surface_mean


@dataclass(frozen=True)
class RelativeTerms(LossTerms):
    """The parameters of L_HDR (Lehtinen et al. 2018, Noise2Noise, §3.3), with a temporal term."""

    epsilon: float = 0.01  # of exposed radiance, of which 0.18 is middle grey
    temporal: float = 1.0  # weight of the temporal term, where there are sequences
    frames: tuple[float, ...] = ()  # weights of a sequence's frames; even if there are none

    def around(self, denoiser: Denoiser) -> "RelativeLoss":
        return RelativeLoss(denoiser, self)


def raised(p: Tensor, epsilon: float) -> Tensor:
    """max(p, 0)^5, what RAE's raw output means, with a gradient that does not die at p <= 0.

    Its slope is that of p^5, but never less than where p^5 = `epsilon`: darker than that, errors are not relative any
    more. A slope of another size, whatever the target, leaves what is best in place: a zero of the loss's gradient.
    """
    value = p.detach().clamp(min=0) ** (1 / POWER)
    slope = p.detach().clamp(min=epsilon**POWER) ** (1 / POWER - 1) / POWER
    return value + slope * (p - p.detach())


def weighted_mean(values: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """Of scalars, one a frame."""
    return torch.stack([w * value for w, value in zip(weights, values, strict=True)]).sum() / sum(weights)


class RelativeLoss(NetworkLoss):
    """(f - y)² / (f + epsilon)², the f below being a constant, + the same of what changes from frame to frame.

    For any network. f and y are exposed radiance, exposure · gain · (irradiance · albedo + emission): it is radiance
    that is shown and measured, and an error of irradiance counts as much as the albedo lets through. Nothing that is
    not linear touches y: then, and only then, is E[y] best where y is noisy. L1 would find its median, tone mapping
    and SMAPE something else that is too dark.

    With A and B the independent halves of the reference it is computed as (f - A)(f - B): the gradient is that of
    (f - y)², y = (A + B) / 2, but the noise of the reference does not count as error. So its value, which may be below
    zero, is an unbiased estimate of the error against a perfect reference, and may be compared between trainings.

    Fireflies in y are not bounded here, for that would bias; a recipe's `clip` bounds what one step makes of them.
    """

    def __init__(self, denoiser: Denoiser, terms: RelativeTerms | None = None):
        super().__init__()
        self.denoiser = denoiser
        self.terms = terms or RelativeTerms()

    def outputs(self, batch: Any) -> Iterator[tuple[Frame, Tensor, RunningScale]]:
        """Each frame with what the network returns and the running scale there."""
        denoiser: Any = self.denoiser
        if isinstance(batch, Crops):
            irradiance, _ = denoiser.filter(batch.frame, batch.irradiance, batch.scale)
            yield batch.frame, irradiance, batch.scale
            return
        state: Any = None
        for frame in batch.frames:
            output, state = denoiser.predict(frame, state)
            yield frame, output, state.scale

    def exposed(self, frame: Frame, output: Tensor, scale: RunningScale) -> tuple[Tensor, Tensor]:
        """Exposed radiance f (B, 3, H, W), at least 0 and without gradient, and the errors f - A, f - B (B, 2, ...).

        The errors are those of what the network returns, which may be below 0.
        """
        signal = self.denoiser.signal
        exposure = scale.exposure() * frame.gain
        is_rae = isinstance(self.denoiser, RAE)
        irradiance = raised(output, self.terms.epsilon) if is_rae else exposure * output
        reflected = irradiance * frame.divisor
        errors = reflected[:, None] - exposure[:, None] * frame.reference_halves(signal)
        shown = reflected.detach().clamp(min=0)
        return (shown + exposure * frame.emission if signal == "total" else shown), errors

    def forward(self, batch: Batch | Crops) -> tuple[Tensor, Parts]:
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        before: Tensor | None = None  # the errors of the frame before
        for frame, output, scale in self.outputs(batch):
            shown, errors = self.exposed(frame, output, scale)
            weight = (shown + self.terms.epsilon) ** -2
            spatial.append(surface_mean(weight * errors.prod(dim=1), frame.depth))
            if before is not None:  # (f_t - f_{t-1}) - (y_t - y_{t-1}) is the change of the error
                temporal.append(surface_mean(weight * (errors - before).prod(dim=1), frame.depth))
            before = errors
        weights = self.terms.frames or [1.0] * len(spatial)
        parts = {"spatial": weighted_mean(spatial, weights)}
        loss = parts["spatial"]
        if temporal and self.terms.temporal:
            parts["temporal"] = weighted_mean(temporal, weights[1:])
            loss = loss + self.terms.temporal * parts["temporal"]
        return loss, {name: part.detach() for name, part in parts.items()}
