"""Recipes: each paper's hyper-parameters as data. Profiles scale the budget, never the method."""

from dataclasses import dataclass, replace

from datasets.sequences import Augmentation
from errors import BadInput


@dataclass(frozen=True)
class Recipe:
    """How one network is trained. The comments name the paper's sections."""

    denoiser: str
    epochs: int
    batch: int  # sequences a step
    crop: int  # pixels
    length: int  # frames a sequence
    betas: tuple[float, float]  # Adam
    peak_rate: float  # learning rate at the end of the ramp
    ramp_epochs: int  # geometric ramp from peak_rate / 10, then peak_rate * sqrt(ramp_epochs / e)
    augmentation: Augmentation

    def learning_rate(self, epoch: float) -> float:
        """Learning rate after `epoch` epochs, fractions included."""
        if epoch < self.ramp_epochs:
            return self.peak_rate * 10 ** (epoch / self.ramp_epochs - 1)
        return self.peak_rate * (self.ramp_epochs / epoch) ** 0.5


RAE_PAPER = Recipe(
    denoiser="rae",
    epochs=500,  # §5.3
    batch=4,  # §5.3
    crop=128,  # §4.3
    length=7,  # §4.3
    betas=(0.9, 0.99),  # §5.3
    peak_rate=1e-3,  # §5.3
    ramp_epochs=10,  # §5.3
    augmentation=Augmentation(reverse=True, stop=True, rotate=True, gain=True),  # §4.3
)

RECIPES: dict[tuple[str, str], Recipe] = {
    ("rae", "paper"): RAE_PAPER,
    ("rae", "tiny"): replace(RAE_PAPER, epochs=15, crop=32, ramp_epochs=1),
    ("rae", "quick"): replace(RAE_PAPER, epochs=60, crop=64, ramp_epochs=2),
}

TRAINABLE = tuple(dict.fromkeys(name for name, _ in RECIPES))


def recipe_for(name: str, profile: str) -> Recipe:
    """The recipe of a denoiser in a profile. Raises BadInput for an unknown one."""
    if name not in TRAINABLE:
        raise BadInput(f"'{name}' is not a network that can be trained; those are {', '.join(TRAINABLE)}")
    if (name, profile) not in RECIPES:
        profiles = [p for n, p in RECIPES if n == name]
        raise BadInput(f"unknown profile '{profile}'; the profiles of '{name}' are {', '.join(profiles)}")
    return RECIPES[name, profile]
