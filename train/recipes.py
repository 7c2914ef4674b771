"""Recipes: each paper's hyper-parameters as data. Profiles scale the budget, never the method."""

from dataclasses import dataclass, field, replace

from datasets.sequences import Augmentation
from errors import BadInput


@dataclass(frozen=True)
class RAETerms:
    """Weights of the loss of RAE §4.4."""

    spatial: float = 0.8  # w_s
    gradient: float = 0.1  # w_g
    temporal: float = 0.1  # w_t
    frames: tuple[float, ...] = (0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0)  # of a sequence, a Gaussian


@dataclass(frozen=True)
class SMAPETerms:
    """The loss of WSKP §5.2, Eq. 6."""

    epsilon: float = 0.01


@dataclass(frozen=True)
class NTDTerms:
    """The three equal parts of the loss of NTD §5, Eq. 6."""

    spatial: float = 1.0  # L_spat
    temporal: float = 1.0  # L_temp
    occlusion: float = 1.0  # L_occ
    masks: tuple[float, ...] = (1.0, 0.8, 0.6)  # w^0, w^1, w^2 of §4.4
    occlusion_start: float = 0.5  # of the epochs: L_occ joins for the last 100 of 200


@dataclass(frozen=True)
class Recipe:
    """How one network is trained."""

    loss: RAETerms | SMAPETerms | NTDTerms
    rate: float  # Adam's learning rate, at the end of the ramp if there is one
    batch: int  # sequences a step
    crop: int | None  # pixels; None: whole frames
    length: int  # frames a sequence
    epochs: int
    betas: tuple[float, float] = (0.9, 0.999)  # of Adam; these are its authors' and PyTorch's
    ramp: int = 0  # epochs of a geometric ramp from rate / 10; then rate * sqrt(ramp / e). 0: a constant rate
    trained: int | None = None  # frames of a sequence that are trained on; the rest is for validation
    crops: tuple[int, int] | None = None  # of each accumulated frame, for training and validation; None: sequences
    augmentation: Augmentation = field(default_factory=Augmentation)

    def learning_rate(self, epoch: float) -> float:
        """Learning rate after `epoch` epochs, fractions included."""
        if epoch < self.ramp:
            return self.rate * 10 ** (epoch / self.ramp - 1)
        return self.rate * (self.ramp / epoch) ** 0.5 if self.ramp else self.rate


RAE = Recipe(
    loss=RAETerms(),  # §4.4
    rate=1e-3,  # §5.3
    betas=(0.9, 0.99),  # §5.3
    ramp=10,  # §5.3
    batch=4,  # §5.3
    crop=128,  # §4.3
    length=7,  # §4.3
    epochs=500,  # §5.3
    augmentation=Augmentation(reverse=True, stop=True, rotate=True, gain=True),  # §4.3
)

WSKP = Recipe(
    loss=SMAPETerms(),  # §5.2
    rate=1e-3,  # §5.3
    batch=64,  # §5.3
    crop=128,  # §5.1
    length=1,  # §4: the history is in the accumulated input
    crops=(80, 20),  # §5.1
    epochs=500,  # §5.3
)

NTD = Recipe(
    loss=NTDTerms(),  # §4.4, §5
    rate=1e-4,  # §5
    batch=1,  # a clip
    crop=None,  # §6.1: 1280 x 720
    length=10,  # §5
    trained=9,  # §5
    epochs=200,  # §5
)
NTD_WITHOUT_OCCLUSION = replace(NTD, loss=NTDTerms(occlusion=0.0))  # §6.3, experiments A and B

PAPER = {
    "rae": RAE,
    **dict.fromkeys(("wskp3", "wskp6", "wskp-mr", "kp"), WSKP),
    **dict.fromkeys(("ntd-a", "ntd-b"), NTD_WITHOUT_OCCLUSION),
    "ntd": NTD,
}

# What a profile changes: epochs and what an epoch holds. An epoch of sequences sees as many pixels as the clips have.
RAE_BUDGETS = {
    "tiny": {"epochs": 15, "crop": 32, "ramp": 1},
    "quick": {"epochs": 50, "crop": 64, "ramp": 2},
    "release": {"epochs": 100, "ramp": 4},
    "paper": {},
}
WSKP_BUDGETS = {
    "tiny": {"epochs": 4, "crop": 32, "crops": (8, 2), "batch": 8},
    "quick": {"epochs": 60, "crop": 64, "crops": (4, 2)},
    "release": {"epochs": 60, "crops": (4, 1)},
    "paper": {},
}
NTD_BUDGETS = {
    "tiny": {"epochs": 15, "crop": 32, "length": 8, "trained": 7},
    "quick": {"epochs": 40, "crop": 128},
    "release": {"epochs": 100, "crop": 128},
    "paper": {},
}

RECIPES: dict[tuple[str, str], Recipe] = {
    (name, profile): replace(recipe, **budget)
    for name, recipe in PAPER.items()
    for kind, budgets in (("rae", RAE_BUDGETS), ("wskp", WSKP_BUDGETS), ("kp", WSKP_BUDGETS), ("ntd", NTD_BUDGETS))
    if name.startswith(kind)
    for profile, budget in budgets.items()
}

TRAINABLE = tuple(PAPER)
DEFAULT = ("rae", "wskp6", "ntd")  # one a paper; what is trained unless something else is named


def recipe_for(name: str, profile: str) -> Recipe:
    """The recipe of a denoiser in a profile. Raises BadInput for an unknown one."""
    if name not in TRAINABLE:
        raise BadInput(f"'{name}' is not a network that can be trained; those are {', '.join(TRAINABLE)}")
    if (name, profile) not in RECIPES:
        profiles = [p for n, p in RECIPES if n == name]
        raise BadInput(f"unknown profile '{profile}'; the profiles of '{name}' are {', '.join(profiles)}")
    return RECIPES[name, profile]
