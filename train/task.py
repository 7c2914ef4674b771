"""What is trained and how, on what, and where that is kept."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from datasets.clip import Clip, Dataset, constant_channels
from errors import BadInput
from models.denoiser import Denoiser
from models.weights import load_weights
from train.augmentation import Augmentation
from train.losses.network_loss import Loss
from train.sequences import check_fits

WEIGHTS_FILE = "weights.safetensors"


def run_folder(runs: Path, name: str, budget: str) -> Path:
    """Where the training of a network in a budget keeps its checkpoint, curves and weights."""
    return runs / "train" / f"{name}-{budget}"


@dataclass(frozen=True)
class Recipe:
    loss: Loss
    rate: float  # Adam's learning rate, at the end of the ramp if there is one
    batch: int  # sequences a step
    crop: int | None  # pixels; None: whole frames
    length: int  # frames a sequence
    epochs: int
    betas: tuple[float, float] = (0.9, 0.999)  # of Adam; these are its authors' and PyTorch's
    ramp: int = 0  # epochs of a geometric ramp from rate / 10; then rate * sqrt(ramp / e). 0: a constant rate
    warm_up: float = (
        0.0  # epochs in which the rate rises from 0, lest Adam's first steps spoil the weights to start from
    )
    anneal: bool = False  # after the ramp the rate falls to zero instead, along half a cosine
    average: float = 0.0  # share of the steps over which weights are averaged to be judged and kept; 0: the last ones
    clip: float | None = None  # the largest norm of a step's gradients; longer ones are shortened to it
    trained: int | None = None  # frames of a sequence that are trained on; the rest is for validation
    firsts: int = 0  # frames of any clip, denoised without history, beside each sequence
    crops: tuple[int, int] | None = None  # of each accumulated frame, for training and validation; None: sequences
    augmentation: Augmentation = field(default_factory=Augmentation)

    def frames(self, training: bool) -> int:
        return self.trained or self.length if training else self.length

    def learning_rate(self, epoch: float) -> float:
        """Learning rate after `epoch` epochs, fractions included, before the last one's end."""
        warmth = min(1.0, epoch / self.warm_up) if self.warm_up else 1.0
        return warmth * self.full_rate(epoch)

    def full_rate(self, epoch: float) -> float:
        """The learning rate but for the warm-up."""
        if epoch < self.ramp:
            return self.rate * 10 ** (epoch / self.ramp - 1)
        if self.anneal:
            return self.rate * (1 + math.cos(math.pi * (epoch - self.ramp) / (self.epochs - self.ramp))) / 2
        return self.rate * (self.ramp / epoch) ** 0.5 if self.ramp else self.rate


@dataclass(frozen=True)
class Task:
    name: str
    create: Callable[[], Denoiser]  # with fresh weights
    recipe: Recipe
    budget: str
    data: Dataset
    folder: Path  # of this training
    cache: Path  # of accumulated frames, which trainings share
    seed: int = 0
    precision: str | None = None  # None: that of the training that is resumed, or else usual_precision
    usual_precision: str = "float32"
    micro_batch: int | None = None  # items in memory together; None: what fits a few gigabytes
    start: Path | None = None  # the weights to begin with instead of fresh ones
    specialised: bool = False  # whether the network does without what does not vary in the data

    def check(self, processes: int) -> None:
        """Raises BadInput where this data set, or so many processes, cannot be trained with."""
        if self.recipe.batch % processes:
            raise BadInput(
                f"a batch of {self.recipe.batch} cannot be shared by {processes} processes: start a divisor of "
                f"{self.recipe.batch}"
            )
        if self.micro_batch is not None and self.micro_batch < 1:
            raise BadInput(f"a micro-batch of {self.micro_batch} items is none: use 1 or more")
        for split, training in (("train", True), ("val", False)):
            check_fits(self.data.clips(split), self.recipe.frames(training), self.recipe.crop, self.recipe.firsts)

    def network(self, clips: list[Clip]) -> Denoiser:
        """The network that the training begins with, specialised to `clips` if it is to be.

        Raises BadInput where the weights to start from cannot be used, or are specialised to other scenes than these,
        and where a network that needs all of its inputs is to be specialised.
        """
        denoiser = self.create()
        if self.start:
            load_weights(denoiser, self.name, self.start)
        constants = constant_channels(clips)
        for name, value in denoiser.constants.items():
            if constants.get(name) != value:
                raise BadInput(
                    f"{self.start} is specialised to scenes whose {name} is {value} everywhere, which it is not in "
                    f"{self.data.path}: start from general weights"
                )
        if self.specialised:
            if not denoiser.dispensable:
                raise BadInput(f"'{self.name}' cannot do without any of its inputs: train it without --specialise")
            denoiser.specialise(constants)
        return denoiser
