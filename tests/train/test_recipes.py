"""The paper recipes are the papers'; other budgets change the effort, and how a training ends."""

from dataclasses import fields, replace

import numpy as np
import pytest

from models.registry import DENOISERS, create
from train.augmentation import Augmentation
from train.losses.ntd import NTDLoss
from train.losses.rae import RAELoss
from train.losses.wskp import NBGDLoss, SMAPELoss
from train.recipes import ONE_A_PAPER, RECIPES, TRAINABLE, recipe_for, trained_by_default

EFFORT = {"epochs", "crop", "ramp", "batch", "crops", "length", "trained", "firsts", "warm_up"}
ENDS_WELL = {"anneal", "average", "rate"}
FOR_NOISY_REFERENCES = {"loss", "clip", "augmentation"}


WSKP = {"batch": 64, "crop": 128, "crops": (80, 20), "epochs": 500, "rate": 1e-3, "loss": SMAPELoss(0.01)}
NTD = {"batch": 1, "length": 10, "trained": 9, "crop": None, "epochs": 200, "rate": 1e-4}
PAPERS = [
    ("rae", {"batch": 4, "length": 7, "crop": 128, "epochs": 500, "betas": (0.9, 0.99)}),
    *((name, WSKP) for name in ("wskp3", "wskp6", "wskp-mr", "kp", "mr-kp")),
    ("nbgd", {"batch": 1, "crop": 128, "crops": (50, 50), "epochs": 100, "rate": 1e-4, "loss": NBGDLoss()}),
    ("ntd", NTD | {"loss": NTDLoss(1.0, 1.0, 1.0, (1.0, 0.8, 0.6), 0.5)}),
    *((name, NTD | {"loss": NTDLoss(1.0, 1.0, 0.0, (1.0, 0.8, 0.6), 0.5)}) for name in ("ntd-a", "ntd-b")),
]


@pytest.mark.parametrize("name, expected", PAPERS)
def test_recipes_are_those_of_the_papers(name, expected):
    recipe = recipe_for(name, "paper")
    assert {key: getattr(recipe, key) for key in expected} == expected
    if name == "rae":
        assert recipe.augmentation == Augmentation(reverse=True, stop=True, rotate=True, gain=True)
        assert recipe.loss == RAELoss(0.8, 0.1, 0.1, (0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0))
        rates = [recipe.learning_rate(epoch) for epoch in (0, 5, 10, 40)]
        assert rates == pytest.approx([1e-4, 1e-4 * 10**0.5, 1e-3, 5e-4])
    else:
        assert recipe.learning_rate(0) == recipe.learning_rate(recipe.epochs - 1) == recipe.rate
        assert recipe.augmentation == Augmentation()


def test_budgets_scale_the_effort_and_anneal():
    for (name, budget), recipe in RECIPES.items():
        paper = RECIPES[name, "paper"]
        # LBF's own loss makes it worse. What `quick` trains on single frames has references of few samples.
        displayed = budget in ("release", "furnished") or (name == "lbf" and budget != "paper")
        displayed |= budget == "quick" and paper.length == 1
        may_differ = EFFORT | ENDS_WELL | (FOR_NOISY_REFERENCES if displayed else set())
        same = {field.name: getattr(recipe, field.name) for field in fields(recipe) if field.name in may_differ}
        assert replace(paper, **same) == recipe, (name, budget)
        assert recipe.epochs <= paper.epochs
        of_a_paper = budget == "paper" and name != "one"
        assert budget == "paper" or recipe.crop
        assert name == "one" or budget == "paper" or recipe.crop <= (paper.crop or recipe.crop)
        assert (recipe.anneal, recipe.average) == ((False, 0.0) if of_a_paper else (True, 0.05))


@pytest.mark.parametrize("name", TRAINABLE)
def test_short_budgets_anneal_to_zero(name):
    """Ramp, top and end by hand; never up again after the ramp."""
    recipe = recipe_for(name, "quick")
    rates = np.array([recipe.learning_rate(epoch) for epoch in np.linspace(recipe.ramp, recipe.epochs, 101)])
    assert rates[0] == recipe.rate and rates[-1] == pytest.approx(0, abs=1e-12)
    assert rates[50] == pytest.approx(recipe.rate / 2) and (np.diff(rates) < 0).all()
    if recipe.ramp:
        assert recipe.learning_rate(0) == pytest.approx(recipe.rate / 10)
        assert recipe.learning_rate(recipe.ramp / 2) == pytest.approx(recipe.rate * 10**-0.5)


def test_every_network_has_recipes_for_all_budgets():
    networks = {name for name in DENOISERS if create(name).parameter_count()}
    assert set(TRAINABLE) == networks and set(ONE_A_PAPER) <= networks
    assert all(set(trained_by_default(budget)) <= networks for _, budget in RECIPES)
    of_all = {(name, budget) for name in networks for budget in ("tiny", "quick", "release", "paper")}
    assert set(RECIPES) == of_all | {(name, "furnished") for name in networks - {"lbf"}}


def test_warm_rates_rise_from_zero():
    recipe = recipe_for("rae", "furnished")
    cold = replace(recipe, warm_up=0)
    assert recipe.warm_up == 1 and recipe.learning_rate(0) == 0
    assert recipe.learning_rate(0.25) == pytest.approx(cold.learning_rate(0.25) / 4)
    assert [recipe.learning_rate(e) for e in (1, 7.5, 20)] == [cold.learning_rate(e) for e in (1, 7.5, 20)]
