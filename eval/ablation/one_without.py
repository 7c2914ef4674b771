"""`one` without some of its parts, for its ablation."""

import torch
from torch import Tensor

from datasets.frame import Frame
from models.denoiser import State
from models.one import Evidence, One, OneState
from models.parameters import LATENT


class WithoutHistory(One):
    """Every frame by itself."""

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, OneState]:
        return super().predict(frame, None)


class WithoutLatent(One):
    """Nothing is carried but images and their length."""

    def evidence(self, frame: Frame, noisy: Tensor, surface: Tensor, before: OneState | None) -> Evidence:
        known = super().evidence(frame, noisy, surface, before)
        images, latent = known.past.split([7, LATENT], dim=1)
        return known._replace(past=torch.cat([images, torch.zeros_like(latent)], dim=1))
