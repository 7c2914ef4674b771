"""A change of light for training: the edge of a shadow, or of more light, that wanders over a sequence's images."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class WanderingEdge:
    """Light is multiplied by `factor` on one side of an edge that moves, slowly or over all the image at once.

    Attributes:
        angle: of the direction in which it moves, radians.
        speed: pixels a frame.
        passes: the frame, and its fraction, in which it passes the middle of the image.
        softness: pixels over which it fades.
    """

    factor: float
    angle: float
    speed: float
    passes: float
    softness: float

    @staticmethod
    def random(rng: np.random.Generator, length: int) -> "WanderingEdge":
        """One that passes within a sequence of `length` frames."""
        return WanderingEdge(
            factor=2 ** float(rng.uniform(-4, 3)),
            angle=float(rng.uniform(0, 2 * math.pi)),
            speed=2 ** float(rng.uniform(-1, 8)),
            passes=float(rng.uniform(0, length - 1)),
            softness=2 ** float(rng.uniform(-1, 4)),
        )

    def light(self, frame: float, height: int, width: int) -> Tensor:
        """What light is multiplied by in a `frame`, (height, width), between 1 and the factor."""
        y = torch.arange(height)[:, None] - (height - 1) / 2
        x = torch.arange(width) - (width - 1) / 2
        ahead = x * math.cos(self.angle) + y * math.sin(self.angle) - self.speed * (frame - self.passes)
        return 1 + (self.factor - 1) * torch.sigmoid(-ahead / self.softness)
