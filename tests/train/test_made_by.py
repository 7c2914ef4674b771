"""Weights and checkpoints name the code and the packages that trained them, and a training by others reports it."""

from importlib.metadata import version
from pathlib import Path

import pytest
import torch

from models.networks.rae import RAE
from models.registry import create
from provenance import MadeBy, differences, made_by_here, sources
from tests.helpers.denoisers import each
from tests.helpers.training import folder_of, makers_of, short_task
from train.loop import train_network
from train.losses.rae import RAELoss
from train.recipes import TRAINABLE, recipe_for
from train.task import WEIGHTS_FILE
from train.training import CHECKPOINT_FILE, Training, load_checkpoint

OTHER_CODE = "0" * 64


def code_of(name: str) -> set[str]:
    """The modules whose code counts for a network."""
    return set(sources("train.loop", type(recipe_for(name, "tiny").loss).__module__, type(create(name)).__module__))


@pytest.mark.parametrize("name", each(TRAINABLE))
def test_the_code_that_counts_is_that_of_network_loss_loop_and_data(name):
    """And not that of all networks and recipes, or of evaluation."""
    modules = code_of(name)
    assert modules >= {type(create(name)).__module__, type(recipe_for(name, "tiny").loss).__module__}
    assert modules >= {f"train.{part}" for part in ("loop", "training", "data", "crops", "accumulation", "task")}
    assert modules >= {"datasets.clip", "datasets.frame", "train.sequences", "datasets.channels", "scenes.camera"}
    assert not modules & {"models.registry", "train.recipes", "onespp"}
    assert not {module for module in modules if module.startswith("eval")}


def test_the_code_of_one_network_does_not_count_for_another():
    assert "models.networks.ntd" not in code_of("rae") | code_of("wskp6")
    assert "models.networks.rae" not in code_of("ntd") | code_of("wskp6")
    assert len({made_by_here(*code_of(name))["code"] for name in ("rae", "ntd", "wskp6")}) == 3


def test_weights_and_checkpoint_name_what_made_them(trained_runs):
    folder = folder_of(trained_runs, "rae")
    here = made_by_here("train.loop", RAELoss.__module__, RAE.__module__)
    assert here["versions"]["torch"] == version("torch") and here["versions"].keys() >= {"numpy", "numba"}
    assert makers_of(folder / WEIGHTS_FILE) == load_checkpoint(folder)["made_by"] == [here]


def test_differences_in_words():
    here: MadeBy = {"versions": {"torch": "2.13.0", "numpy": "2.4.6"}, "code": "a"}
    assert differences([], here) == differences([here], here) == ""
    assert differences([{**here, "code": "b"}], here) == "other code"
    older: MadeBy = {"versions": {"torch": "2.12.0", "numpy": "2.4.6"}, "code": "a"}
    assert differences([older], here) == "torch 2.12.0 (now 2.13.0)"
    several: list[MadeBy] = [{**older, "code": "b"}, here, {**here, "code": "c"}]
    assert differences(several, here) == "other code, torch 2.12.0 (now 2.13.0)"
    assert differences([{**here, "versions": {"torch": "2.13.0"}}], here) == "numpy none (now 2.4.6)"


def change_code(folder: Path) -> None:
    """Let a checkpoint name other code."""
    checkpoint = load_checkpoint(folder)
    checkpoint["made_by"][0]["code"] = OTHER_CODE
    torch.save(checkpoint, folder / CHECKPOINT_FILE)


def test_a_finished_training_by_other_code_is_kept_and_reported(tiny, tmp_path, trained_copy, capsys):
    task = short_task("rae", tiny, tmp_path, precision=None)
    weights = trained_copy / WEIGHTS_FILE
    before = weights.read_bytes()
    assert train_network(task) == weights
    assert capsys.readouterr().out == f"rae: trained, {weights}\n"
    change_code(trained_copy)
    assert train_network(task) == weights
    advice = f"kept at {weights}; delete {trained_copy} to train again\n"
    assert capsys.readouterr().out == f"rae: trained with other code, {advice}"
    assert weights.read_bytes() == before


def test_a_training_begun_by_other_code_is_resumed_and_names_both(tiny, tmp_path, capsys):
    task = short_task("wskp6", tiny, tmp_path, epochs=1, crops=(1, 1))
    begun = Training(task)
    task.folder.mkdir(parents=True)
    begun.save()
    change_code(task.folder)
    weights = train_network(task)
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith("wskp6: begun with other code, resumed with what is here")
    assert out[1:] == [f"wskp6: trained, {weights}"]
    older = {**begun.made_by_here, "code": OTHER_CODE}
    assert makers_of(weights) == load_checkpoint(task.folder)["made_by"] == [older, begun.made_by_here]
