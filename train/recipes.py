"""The recipes of the papers as data, each number with its section; what budgets change; trainings by their names."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from datasets.clip import Dataset
from errors import BadInput
from models.registry import create
from models.spec import fastest_precision
from train.augmentation import Augmentation
from train.losses.displayed import DisplayedLoss
from train.losses.ntd import NTDLoss
from train.losses.rae import RAELoss
from train.losses.wskp import LBFLoss, NBGDLoss, SMAPELoss
from train.task import Recipe, Task, run_folder

RAE_RECIPE = Recipe(
    loss=RAELoss(),  # §4.4
    rate=1e-3,  # §5.3
    betas=(0.9, 0.99),  # §5.3
    ramp=10,  # §5.3
    batch=4,  # §5.3
    crop=128,  # §4.3
    length=7,  # §4.3
    epochs=500,  # §5.3
    augmentation=Augmentation(reverse=True, stop=True, rotate=True, gain=True),  # §4.3
)

WSKP_RECIPE = Recipe(
    loss=SMAPELoss(),  # §5.2
    rate=1e-3,  # §5.3
    batch=64,  # §5.3
    crop=128,  # §5.1
    length=1,  # §4: the history is in the accumulated input
    crops=(80, 20),  # §5.1
    epochs=500,  # §5.3
)

# The defaults of its authors' code, as we do not have the paper's text. That also rotates and mirrors crops.
NBGD_RECIPE = Recipe(loss=NBGDLoss(), rate=1e-4, batch=1, crop=128, length=1, crops=(50, 50), epochs=100)

# The loss is its authors'; more is not known. Without a bound, a few fireflies' gradients would widen all filters.
LBF_RECIPE = Recipe(loss=LBFLoss(), rate=1e-2, batch=4, crop=128, length=1, crops=(4, 1), epochs=100, clip=1.0)

NTD_RECIPE = Recipe(
    loss=NTDLoss(),  # §4.4, §5
    rate=1e-4,  # §5
    batch=1,  # a clip
    crop=None,  # §6.1: 1280 x 720
    length=10,  # §5
    trained=9,  # §5
    epochs=200,  # §5
)
NTD_RECIPE_WITHOUT_OCCLUSION = replace(NTD_RECIPE, loss=NTDLoss(occlusion=0.0))  # §6.3, experiments A and B

Budgets = dict[str, dict[str, Any]]  # changes of a recipe, by budget; in the budget "paper" there are none

# Ours, for trainings that are too short for the papers' rates, at which the weights would still jitter at the end.
SHORT: dict[str, Any] = {"anneal": True, "average": 0.05}

# Ours: sequences long enough to learn what to carry, in all exposures and with all numbers of samples.
ONE_RECIPE = Recipe(
    loss=DisplayedLoss(),
    rate=2e-3,
    batch=4,
    crop=64,
    length=8,
    epochs=40,
    clip=1.0,
    augmentation=Augmentation(stop=True, rotate=True, exposure=True, samples=True, light=True),
    **SHORT,
)

# Ours, where references have few samples: of single noisy pixels the papers' losses learn the median
# (docs/training.md).
# A network without coarse levels cannot help what is wrong in large blocks.
RELEASE: dict[str, Any] = SHORT | {"loss": DisplayedLoss(), "crop": 64, "clip": 1.0}
RELEASE_CROPS = RELEASE | {"loss": DisplayedLoss(scales=(1, 4)), "crops": (4, 1), "batch": 16, "rate": 4e-3}

# An epoch of sequences has as many pixels as the clips.
RAE_BUDGETS = {
    "tiny": SHORT | {"epochs": 15, "crop": 32, "ramp": 1},
    "quick": SHORT | {"epochs": 50, "crop": 64, "ramp": 2},
    "release": RELEASE | {"epochs": 15, "ramp": 0},  # it predicts colours, and needs the paper's gains
    # Here and below, `furnished` continues the weights of `release`, with --from.
    "furnished": RELEASE | {"epochs": 20, "ramp": 0, "warm_up": 1, "crop": 128, "batch": 16},
}
# In a thousand steps WSKP gets further at a higher rate than the paper's (docs/training.md).
WSKP_BUDGETS = {
    "tiny": SHORT | {"epochs": 4, "crop": 32, "crops": (8, 2), "batch": 8},
    "quick": RELEASE_CROPS | {"epochs": 5, "crops": (4, 2)},
    "release": RELEASE_CROPS | {"epochs": 8},
    "furnished": RELEASE_CROPS | {"epochs": 36, "warm_up": 2, "crop": 128, "batch": 64},
}
# In so few steps the authors' rate leaves the weights where they began.
NBGD_BUDGETS = WSKP_BUDGETS | {"tiny": WSKP_BUDGETS["tiny"] | {"rate": 2e-3}}
# 436 weights learn from few pixels; each costs thousands of taps.
LBF_BUDGETS: Budgets = {
    "tiny": SHORT | {"epochs": 2, "rate": 3e-3, "crop": 32, "loss": DisplayedLoss()},
    "quick": SHORT | {"epochs": 1, "rate": 3e-3, "crop": 64, "loss": DisplayedLoss()},
    "release": RELEASE | {"epochs": 1, "rate": 3e-3},
}
NTD_RELEASE: dict[str, Any] = (
    RELEASE
    | {"epochs": 10, "rate": 5e-4, "batch": 2, "length": 8, "trained": None}
    | {"augmentation": Augmentation(stop=True, rotate=True, exposure=True)}
)
NTD_BUDGETS = {
    "tiny": SHORT | {"epochs": 8, "crop": 32, "length": 8, "trained": 7},
    "quick": SHORT | {"epochs": 40, "crop": 128},
    "release": NTD_RELEASE,
    "furnished": NTD_RELEASE | {"epochs": 9, "warm_up": 0.5, "crop": 128, "batch": 8},
}

ONE_BUDGETS: Budgets = {
    "tiny": {"epochs": 15, "crop": 32, "length": 4},
    "quick": {"epochs": 10},
    "release": {"epochs": 16, "rate": 1e-3, "length": 12, "crop": 80, "loss": DisplayedLoss(temporal=0.5)},
    # Continues the weights of `release`, with --from. Of twelve frames one has no history: more of these beside them.
    "furnished": {"epochs": 24, "rate": 7e-4, "batch": 6, "length": 12, "crop": 80, "firsts": 4}
    | {"loss": DisplayedLoss(temporal=0.5, squared=25.0)},
}

PAPERS_AND_BUDGETS: dict[str, tuple[Recipe, Budgets]] = {
    "rae": (RAE_RECIPE, RAE_BUDGETS),
    **dict.fromkeys(("wskp3", "wskp6", "wskp-mr", "kp", "mr-kp"), (WSKP_RECIPE, WSKP_BUDGETS)),
    "nbgd": (NBGD_RECIPE, NBGD_BUDGETS),
    "lbf": (LBF_RECIPE, LBF_BUDGETS),
    **dict.fromkeys(("ntd-a", "ntd-b"), (NTD_RECIPE_WITHOUT_OCCLUSION, NTD_BUDGETS)),
    **dict.fromkeys(("ntd", "ntd-mean"), (NTD_RECIPE, NTD_BUDGETS)),
    "one": (ONE_RECIPE, ONE_BUDGETS),
}

RECIPES: dict[tuple[str, str], Recipe] = {
    (name, budget): replace(recipe, **changes)
    for name, (recipe, budgets) in PAPERS_AND_BUDGETS.items()
    for budget, changes in (budgets | {"paper": {}}).items()
}

TRAINABLE = tuple(PAPERS_AND_BUDGETS)
ONE_A_PAPER = ("rae", "wskp6", "ntd-mean")
WORTH_TRAINING = {"quick": ("wskp6",), "furnished": ("one",)}  # where the others still blur, or have no recipe


def trained_by_default(budget: str) -> tuple[str, ...]:
    """The networks that are trained unless others are named: those that the budget can train well."""
    return WORTH_TRAINING.get(budget, ONE_A_PAPER)


def recipe_for(name: str, budget: str) -> Recipe:
    """The recipe of a network in a budget. Raises BadInput for an unknown one."""
    if name not in TRAINABLE:
        raise BadInput(f"'{name}' is not a network that can be trained; those are {', '.join(TRAINABLE)}")
    if (name, budget) not in RECIPES:
        budgets = [each for network, each in RECIPES if network == name]
        raise BadInput(f"unknown budget '{budget}'; the budgets of '{name}' are {', '.join(budgets)}")
    return RECIPES[name, budget]


def task_for(name: str, data: Path, runs: Path, budget: str) -> Task:
    """The training of a denoiser in a budget. Raises BadInput for an unknown name or budget, or no data."""
    return Task(
        name=name,
        create=partial(create, name),
        recipe=recipe_for(name, budget),
        budget=budget,
        data=Dataset(data),
        folder=run_folder(runs, name, budget),
        cache=runs / "accumulated",
        usual_precision=fastest_precision(name, "cuda" if torch.cuda.is_available() else "cpu"),
    )
