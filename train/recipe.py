"""A recipe: how one network is trained."""

import math
from dataclasses import dataclass, field

from train.augmentation import Augmentation
from train.losses.network_loss import Loss


@dataclass(frozen=True)
class Recipe:
    """How one network is trained."""

    loss: Loss
    rate: float  # Adam's learning rate, at the end of the ramp if there is one
    batch: int  # sequences a step
    crop: int | None  # pixels; None: whole frames
    length: int  # frames a sequence
    epochs: int
    betas: tuple[float, float] = (0.9, 0.999)  # of Adam; these are its authors' and PyTorch's
    ramp: int = 0  # epochs of a geometric ramp from rate / 10; then rate * sqrt(ramp / e). 0: a constant rate
    anneal: bool = False  # after the ramp the rate falls to zero instead, along half a cosine
    average: float = 0.0  # share of the steps over which weights are averaged to be judged and kept; 0: the last ones
    clip: float | None = None  # the largest norm of a step's gradients; longer ones are shortened to it
    trained: int | None = None  # frames of a sequence that are trained on; the rest is for validation
    crops: tuple[int, int] | None = None  # of each accumulated frame, for training and validation; None: sequences
    augmentation: Augmentation = field(default_factory=Augmentation)

    def frames(self, training: bool) -> int:
        """Frames of a sequence, in training or in validation."""
        return self.trained or self.length if training else self.length

    def learning_rate(self, epoch: float) -> float:
        """Learning rate after `epoch` epochs, fractions included, before the last one's end."""
        if epoch < self.ramp:
            return self.rate * 10 ** (epoch / self.ramp - 1)
        if self.anneal:
            return self.rate * (1 + math.cos(math.pi * (epoch - self.ramp) / (self.epochs - self.ramp))) / 2
        return self.rate * (self.ramp / epoch) ** 0.5 if self.ramp else self.rate
