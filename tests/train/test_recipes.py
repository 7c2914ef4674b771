"""The paper recipes are the papers'; other budgets change the effort, and how a training ends."""

from dataclasses import fields, replace

import numpy as np
import pytest

from errors import BadInput
from models.registry import DENOISERS, create
from train.augmentation import Augmentation
from train.losses.displayed import DisplayedLoss
from train.losses.ntd import NTDLoss
from train.losses.rae import RAELoss
from train.losses.wskp import NBGDLoss, SMAPELoss
from train.recipes import ONE_A_PAPER, RECIPES, TRAINABLE, recipe_for, trained_by_default

EFFORT = {"epochs", "crop", "ramp", "batch", "crops", "length", "trained"}
ENDS_WELL = {"anneal", "average", "rate"}
FOR_NOISY_REFERENCES = {"loss", "clip", "augmentation"}


def test_rae_is_the_paper_s():
    recipe = recipe_for("rae", "paper")
    assert recipe.learning_rate(0) == pytest.approx(1e-4)
    assert recipe.learning_rate(5) == pytest.approx(1e-4 * 10**0.5)
    assert recipe.learning_rate(10) == pytest.approx(1e-3)
    assert recipe.learning_rate(40) == pytest.approx(5e-4)
    assert (recipe.batch, recipe.length, recipe.crop, recipe.epochs, recipe.betas) == (4, 7, 128, 500, (0.9, 0.99))
    assert recipe.augmentation == Augmentation(True, True, True, True)
    assert recipe.loss == RAELoss(0.8, 0.1, 0.1, (0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1.0))


@pytest.mark.parametrize("name", ["wskp3", "wskp6", "wskp-mr", "kp", "mr-kp"])
def test_wskp_is_the_paper_s(name):
    recipe = recipe_for(name, "paper")
    assert (recipe.batch, recipe.crop, recipe.crops, recipe.epochs, recipe.rate) == (64, 128, (80, 20), 500, 1e-3)
    assert recipe.loss == SMAPELoss(0.01) and recipe.augmentation == Augmentation()
    assert recipe.learning_rate(0) == recipe.learning_rate(499) == 1e-3


def test_nbgd_is_its_authors():
    recipe = recipe_for("nbgd", "paper")
    assert (recipe.batch, recipe.crop, recipe.crops, recipe.epochs, recipe.rate) == (1, 128, (50, 50), 100, 1e-4)
    assert recipe.loss == NBGDLoss() and recipe.augmentation == Augmentation()


@pytest.mark.parametrize("name, occlusion", [("ntd-a", 0.0), ("ntd-b", 0.0), ("ntd", 1.0)])
def test_ntd_is_the_paper_s(name, occlusion):
    recipe = recipe_for(name, "paper")
    assert (recipe.batch, recipe.length, recipe.trained, recipe.crop, recipe.epochs) == (1, 10, 9, None, 200)
    assert recipe.loss == NTDLoss(1.0, 1.0, occlusion, (1.0, 0.8, 0.6), 0.5)
    assert recipe.learning_rate(0) == recipe.learning_rate(199) == 1e-4 and recipe.augmentation == Augmentation()


def test_budgets_scale_the_effort_and_anneal():
    for (name, budget), recipe in RECIPES.items():
        paper = RECIPES[name, "paper"]
        may_differ = EFFORT | ENDS_WELL | (FOR_NOISY_REFERENCES if budget == "release" else set())
        same = {field.name: getattr(recipe, field.name) for field in fields(recipe) if field.name in may_differ}
        assert replace(paper, **same) == recipe, (name, budget)
        assert recipe.epochs <= paper.epochs
        of_a_paper = budget == "paper" and name != "one"
        assert budget == "paper" or recipe.crop
        assert name == "one" or budget == "paper" or recipe.crop <= (paper.crop or recipe.crop)
        assert (recipe.anneal, recipe.average) == ((False, 0.0) if of_a_paper else (True, 0.05))


@pytest.mark.parametrize("name", TRAINABLE)
def test_what_is_shipped_learns_from_noisy_references(name):
    """Without the blocks of 16 where a network filters single frames by small windows."""
    recipe = recipe_for(name, "release")
    assert isinstance(recipe.loss, DisplayedLoss)
    assert recipe.loss.scales == ((1, 4) if recipe.crops else (1, 4, 16))
    assert recipe.clip == 1.0 and recipe.augmentation.rotate is (recipe.crops is None)


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
    assert set(RECIPES) == {(name, budget) for name in networks for budget in ("tiny", "quick", "release", "paper")}


def test_unknown_names_are_told_apart():
    with pytest.raises(BadInput, match="'accumulated' is not a network"):
        recipe_for("accumulated", "tiny")
    with pytest.raises(BadInput, match=r"unknown budget 'huge'; the budgets of 'rae' are tiny, quick, release, paper"):
        recipe_for("rae", "huge")
