"""RAE without demodulation, as the paper's ablation of inputs has it."""

from dataclasses import replace

import torch
from torch import Tensor

from datasets.frame import Frame
from models.denoiser import State
from models.rae import RAE, RAEState


class TexturedRAE(RAE):
    """RAE on colour that is not demodulated: every surface counts as white (Chaitanya et al. 2017, §5.1)."""

    @staticmethod
    def white(frame: Frame) -> Frame:
        return replace(frame, channels=frame.channels | {"albedo": torch.ones_like(frame.albedo)})

    def predict(self, frame: Frame, state: State | None) -> tuple[Tensor, RAEState]:
        return super().predict(self.white(frame), state)

    def target(self, frame: Frame) -> Tensor:
        """Radiance without emission, (B, 3, H, W)."""
        return super().target(self.white(frame))

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return super().forward(self.white(frame), state)
