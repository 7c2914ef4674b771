"""The relative squared error, whose best network is right on the mean of noisy targets."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from models.denoiser import Denoiser
from train.crops import AnyBatch
from train.losses.network_loss import Loss, Parts, exposed_outputs, surface_mean


def weighted_mean(values: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """Of scalars, one per frame."""
    return torch.stack([w * value for w, value in zip(weights, values, strict=True)]).sum() / sum(weights)


@dataclass(frozen=True)
class RelativeLoss(Loss):
    """L_HDR (Lehtinen et al. 2018, Noise2Noise, §3.3): (f - y)² / (f + epsilon)², the f below being a constant.

    To it comes the same of what changes from frame to frame. For any network. f and y are exposed radiance,
    exposure · gain · (irradiance · albedo + emission): it is radiance that is shown and measured, and an error of
    irradiance counts as much as the albedo lets through. Nothing that is not linear touches y: then, and only then, is
    E[y] best where y is noisy. L1 would find its median, tone mapping and SMAPE something else that is too dark.

    With A and B the independent sample buffers of the reference it is computed as (f - A)(f - B): the gradient is that
    of (f - y)², y = (A + B) / 2, but the noise of the reference does not count as error. So its value, which may be
    below zero, is an unbiased estimate of the error against a perfect reference, and may be compared between trainings.

    Fireflies in y are not bounded here, for that would bias; a recipe's `clip` bounds their effect on a step.
    """

    epsilon: float = 0.01  # of exposed radiance, of which 0.18 is middle grey
    temporal: float = 1.0  # weight of the temporal term, where there are sequences
    frames: tuple[float, ...] = ()  # weights of a sequence's frames; even if there are none

    def compute(self, network: Denoiser, batch: AnyBatch, progress: float) -> tuple[Tensor, Parts]:
        spatial: list[Tensor] = []
        temporal: list[Tensor] = []
        before: Tensor | None = None  # the errors of the frame before
        for frame, reflected, exposure in exposed_outputs(network, batch):
            errors = reflected[:, None] - exposure[:, None] * frame.reference_buffers(network.signal)
            errors = torch.where(frame.depth[:, None] > 0, errors, 0)
            shown = reflected.detach().clamp(min=0)
            if network.signal == "total":
                shown = shown + exposure * frame.emission
            weight = (shown + self.epsilon) ** -2
            spatial.append(surface_mean(weight * errors.prod(dim=1), frame.depth))
            if before is not None:  # (f_t - f_{t-1}) - (y_t - y_{t-1}) is the change of the error
                temporal.append(surface_mean(weight * (errors - before).prod(dim=1), frame.depth))
            before = errors
        weights = self.frames or [1.0] * len(spatial)
        parts = {"spatial": weighted_mean(spatial, weights)}
        loss = parts["spatial"]
        if temporal and self.temporal:
            parts["temporal"] = weighted_mean(temporal, weights[1:])
            loss = loss + self.temporal * parts["temporal"]
        return loss, parts
