"""Weights and checkpoints name the code and the packages that made them, and a training by others says so."""

import json
from importlib.metadata import version
from pathlib import Path

import pytest
import torch

from models.networks.ntd import NTD
from models.networks.rae import RAE
from models.networks.wskp import WSKP
from models.registry import create
from provenance import sources
from tests.helpers.training import folder_of, makers_of, short_task
from train.checkpoint import CHECKPOINT_FILE, load_checkpoint
from train.loop import train_network
from train.losses.ntd import NTDLoss
from train.losses.rae import RAELoss
from train.losses.wskp import SMAPELoss
from train.made_by import UNKNOWN, maker_here, other_makers
from train.recipes import TRAINABLE, recipe_for
from train.task import WEIGHTS_FILE
from train.training import Training

OTHER_CODE = "0" * 64


def change_makers(folder: Path, makers: list[dict] | None) -> None:
    """Let a checkpoint name other makers, or none as those of earlier versions."""
    checkpoint = load_checkpoint(folder)
    del checkpoint["made_by"]
    torch.save(checkpoint if makers is None else {**checkpoint, "made_by": makers}, folder / CHECKPOINT_FILE)


def code_of(name: str) -> set[str]:
    """The modules whose code counts for a network."""
    loss = recipe_for(name, "tiny").loss.around(create(name))
    return set(sources("train.loop", type(loss).__module__, type(loss.denoiser).__module__))


@pytest.mark.parametrize("name", TRAINABLE)
def test_the_code_that_counts_is_that_of_network_loss_loop_and_data(name):
    """And not that of all networks and recipes, or of evaluation."""
    modules = code_of(name)
    assert modules >= {type(create(name)).__module__, type(recipe_for(name, "tiny").loss).__module__}
    assert modules >= {
        "train.loop",
        "train.training",
        "train.data",
        "train.crops",
        "train.accumulation",
        "train.recipe",
    }
    assert modules >= {"datasets.clip", "datasets.frame", "train.sequences", "datasets.channels", "scenes.camera"}
    assert not modules & {"models.registry", "train.registry", "train.recipes", "onespp"}
    assert not {module for module in modules if module.startswith("eval")}


def test_one_network_s_code_does_not_count_for_another():
    assert "models.networks.ntd" not in code_of("rae") | code_of("wskp6")
    assert "models.networks.rae" not in code_of("ntd") | code_of("wskp6")
    assert len({maker_here(loss)["code"] for loss in (RAELoss(RAE()), NTDLoss(NTD()), SMAPELoss(WSKP()))}) == 3


def test_weights_and_checkpoint_name_what_made_them(trained_runs):
    folder = folder_of(trained_runs, "rae")
    here = maker_here(RAELoss(RAE()))
    assert here["versions"]["torch"] == version("torch") and here["versions"].keys() >= {"numpy", "numba"}
    assert makers_of(folder / WEIGHTS_FILE) == load_checkpoint(folder)["made_by"] == [here]


def test_what_differs_is_told_in_words():
    here = {"versions": {"torch": "2.13.0", "numpy": "2.4.6"}, "code": "a"}
    assert other_makers([], here) == other_makers([here], here) == ""
    assert other_makers([{**here, "code": "b"}], here) == "other code"
    older = {"versions": {"torch": "2.12.0", "numpy": "2.4.6"}, "code": "a"}
    assert other_makers([older], here) == "torch 2.12.0 (now 2.13.0)"
    several = [{**older, "code": "b"}, here, {**here, "code": "c"}]
    assert other_makers(several, here) == "other code, torch 2.12.0 (now 2.13.0)"
    assert other_makers([{**here, "versions": {"torch": "2.13.0"}}], here) == "numpy none (now 2.4.6)"
    assert other_makers([UNKNOWN, here], here) == "older code"


def test_a_finished_training_by_other_code_says_so_and_is_kept(tiny, tmp_path, trained_copy, capsys):
    task = short_task("rae", tiny, tmp_path, precision=None)
    before = (trained_copy / WEIGHTS_FILE).read_bytes()

    def said() -> str:
        assert train_network(task) == trained_copy / WEIGHTS_FILE
        return capsys.readouterr().out

    assert said() == f"rae: trained, {trained_copy / WEIGHTS_FILE}\n"
    here = load_checkpoint(trained_copy)["made_by"][0]
    older = {"versions": {**here["versions"], "torch": "2.0.0"}, "code": OTHER_CODE}
    change_makers(trained_copy, [older])
    advice = f"kept at {trained_copy / WEIGHTS_FILE}; delete {trained_copy} to train again\n"
    now = version("torch")
    assert said() == f"rae: trained with other code, torch 2.0.0 (now {now}), {advice}"
    change_makers(trained_copy, None)
    assert said() == f"rae: trained with older code, {advice}"
    assert (trained_copy / WEIGHTS_FILE).read_bytes() == before


@pytest.mark.parametrize("recorded", [True, False])
def test_a_training_begun_by_other_code_goes_on_and_names_both(tiny, tmp_path, capsys, recorded):
    task = short_task("wskp6", tiny, tmp_path, epochs=1, crops=(1, 1))
    begun = Training(task)
    task.folder.mkdir(parents=True)
    begun.save()
    older = {**begun.maker, "code": OTHER_CODE} if recorded else UNKNOWN
    words = "other code" if recorded else "older code"
    change_makers(task.folder, [older] if recorded else None)
    weights = train_network(task)
    out = capsys.readouterr().out.splitlines()
    assert out[0].startswith(f"wskp6: begun with {words}, goes on with what is here")
    assert out[1:] == [f"wskp6: trained, {weights}"]
    assert makers_of(weights) == load_checkpoint(task.folder)["made_by"] == [older, begun.maker]
    train_network(task)
    assert f"trained with {words}, kept at" in capsys.readouterr().out


def test_precisions_of_earlier_checkpoints_are_known(trained_copy):
    checkpoint = load_checkpoint(trained_copy)
    assert checkpoint["precision"] == "bfloat16"
    torch.save({**checkpoint, "precision": "bf16-mixed"}, trained_copy / CHECKPOINT_FILE)
    assert load_checkpoint(trained_copy)["precision"] == "bfloat16"
    assert json.dumps(load_checkpoint(trained_copy)["made_by"])  # plain data
