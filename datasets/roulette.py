"""Light that is harder to find, for training: few of a frame's samples survive, and those count for more."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from datasets.channels import NOISY
from datasets.frame import Frame


@dataclass(frozen=True)
class Roulette:
    """Russian roulette with samples: noise as of light that is found by fewer paths, the mean stays.

    Attributes:
        survival: by noisy channel, the probability with which a sample survives; it is then divided by that.
    """

    survival: dict[str, float]

    @staticmethod
    def random(rng: np.random.Generator) -> "Roulette":
        """One in which from all samples of a channel down to one in 16 survive."""
        return Roulette({name: 2 ** -float(rng.uniform(0, 4)) for name in NOISY})

    def play(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame of one realisation with what is left of its noisy channels."""
        left = {}
        for name in NOISY:
            if name in frame.channels:
                sample = frame.channels[name]
                survives = rng.random(sample.shape[-2:], dtype=np.float32) < self.survival[name]
                left[name] = sample * torch.from_numpy(survives) / self.survival[name]
        return replace(frame, channels=frame.channels | left)
