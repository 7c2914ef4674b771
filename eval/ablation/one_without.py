"""`one` without some of its parts, for its ablation."""

from dataclasses import replace

import torch
from torch import Tensor

from datasets.frame import Frame
from models.denoiser import State
from models.one import Evidence, One, OneState


class WithoutHistory(One):
    """Every frame by itself."""

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, OneState]:
        return super().predict(frame, None)


class WithoutLatent(One):
    """Nothing is carried but images and their length."""

    def evidence(self, frame: Frame, noisy: Tensor, surface: Tensor, before: OneState | None) -> Evidence:
        known = super().evidence(frame, noisy, surface, before)
        return replace(known, latent=torch.zeros_like(known.latent))
