"""Trainings that begin with trained weights, and networks specialised to a data set."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from command_line import main
from datasets.clip import Dataset
from datasets.frame import read_frame
from errors import BadInput
from models.registry import shipped_weights
from models.spec import load
from provenance import file_digest
from tests.helpers.denoisers import each
from tests.helpers.frames import run
from tests.helpers.training import SHORT, folder_of, fresh_weights, metadata, short_task, tensors
from tests.test_cli import fails
from train.loop import train_network
from train.recipes import TRAINABLE, task_for
from train.task import WEIGHTS_FILE, Task
from train.training import Training

GREY = {"value": [0.5, 0.5, 0.5]}


@pytest.fixture
def general(tmp_path) -> Path:
    return fresh_weights("wskp3", tmp_path / "general.safetensors", seed=5)


@pytest.fixture
def grey(tiny, tmp_path) -> Path:
    """The tiny data set, all of whose surfaces have the same grey albedo in training and validation."""
    copy = Path(shutil.copytree(tiny, tmp_path / "grey"))
    for path in [*copy.glob("train/*/*/clip.json"), *copy.glob("val/*/*/clip.json")]:
        facts = json.loads(path.read_text())
        facts["channels"]["albedo"] = GREY
        path.write_text(json.dumps(facts))
    return copy


def short(name: str, data: Path, runs: Path, **arguments) -> Task:
    """A training of a few steps from other weights, or specialised."""
    task = replace(task_for(name, data, runs, "tiny"), precision="float32", **arguments)
    return replace(task, recipe=replace(task.recipe, **SHORT["rae" if name == "rae" else "wskp6"]))


def test_it_begins_with_the_general_network_bit_for_bit(tiny, tmp_path, general):
    training = Training(short("wskp3", tiny, tmp_path, start=general))
    wanted = tensors(general)
    assert "network.0.branches.2.weight" in wanted  # what was merged for inference could not be trained further
    for denoiser in (training.loss.module.denoiser, training.judged.denoiser):
        begun = denoiser.state_dict()
        assert begun.keys() == wanted.keys() and all(torch.equal(begun[key], wanted[key]) for key in wanted)


OFTEN = "nbgd"  # the others take longer


@pytest.mark.parametrize("name", each(TRAINABLE, *(name for name in TRAINABLE if name != OFTEN)))
def test_no_network_ends_worse_than_it_began(tiny, tmp_path, name):
    """By the validation loss, at a rate a thousand times too high; the weights kept are those of that loss."""
    task = replace(task_for(name, tiny, tmp_path, "tiny"), precision="float32")
    task = replace(task, recipe=replace(task.recipe, **few_steps(task), rate=1e3, ramp=0))
    start = Training(task).validate()
    weights = train_network(task)
    kept = json.loads(metadata(weights)["recipe"])["validation"]
    assert kept <= start
    again = Training(replace(task, folder=tmp_path / "again", start=weights))
    assert again.validate() == pytest.approx(kept, rel=1e-3)


def few_steps(task: Task) -> dict[str, Any]:
    """Changes to a recipe: one epoch, of sequences or of a few crops a frame."""
    return {"epochs": 1} if task.recipe.length > 1 else {"epochs": 1, "crops": (2, 1)}


@pytest.mark.parametrize("name", ["wskp3", pytest.param("rae", marks=pytest.mark.slow)])
def test_a_training_that_makes_it_worse_keeps_its_start(tiny, tmp_path, name):
    task = short(name, tiny, tmp_path)
    task = replace(task, recipe=replace(task.recipe, rate=1e3, ramp=0))
    start = Training(task).judged.denoiser.state_dict()
    weights = train_network(task)
    assert json.loads(metadata(weights)["recipe"])["step"] == 0
    assert all(torch.equal(start[key], kept) for key, kept in tensors(weights).items())


def test_its_weights_and_checkpoint_name_what_it_began_with(tiny, tmp_path, general):
    task = short("wskp3", tiny, tmp_path / "runs", start=general)
    weights = train_network(task)
    assert json.loads(metadata(weights)["recipe"])["from"] == file_digest(general)
    assert train_network(task) == weights  # finished
    other = fresh_weights("wskp3", tmp_path / "other.safetensors", seed=6)
    for start in (other, None):
        with pytest.raises(BadInput, match="another recipe, seed, data set or start"):
            train_network(replace(task, start=start))
    shutil.copyfile(general, tmp_path / "moved.safetensors")
    assert train_network(replace(task, start=tmp_path / "moved.safetensors")) == weights


def test_weights_that_cannot_be_begun_with_are_named(capsys, tiny, tmp_path, general):
    there = ["--data", str(tiny), "--runs", str(tmp_path / "runs"), "--budget", "tiny"]
    assert "there are no weights at missing" in fails(capsys, "train", "wskp3", "--from", "missing", *there)
    assert "holds weights of 'wskp3', not of 'rae'" in fails(capsys, "train", "rae", "--from", str(general), *there)
    folder = str(general.parent)
    assert f"{folder} is a folder: name the file" in fails(capsys, "train", "wskp3", "--from", folder, *there)
    assert not list(tmp_path.glob("runs/train/*/[!.]*"))


@pytest.mark.slow
def test_it_may_begin_with_what_is_shipped(capsys, tiny, tmp_path, shipped):
    ours = fresh_weights("wskp3", shipped / "wskp3.safetensors", seed=5)
    there = ["--data", str(tiny), "--runs", str(tmp_path / "runs"), "--budget", "tiny", "--from", "weights"]
    assert "no weights of 'rae' are shipped; those are wskp3" in fails(capsys, "train", "rae", *there)
    assert not (tmp_path / "runs").exists()
    main(["train", "wskp3", *there, "--precision", "float32"])
    weights = folder_of(tmp_path / "runs", "wskp3") / WEIGHTS_FILE
    assert json.loads(metadata(weights)["recipe"])["from"] == file_digest(ours)


def test_what_does_not_vary_is_left_out(capsys, tiny, grey, tmp_path, general):
    """Before the first step nothing has changed, but near the border of the image."""
    task = short("wskp3", grey, tmp_path, start=general, specialised=True)
    training = Training(task)
    special = training.judged.denoiser
    assert special.constants == {"albedo": GREY["value"]} and training.facts["constants"] == special.constants
    frame = read_frame(Dataset(grey).clips("val")[0], 0, special.reads)
    before = load("wskp3", general, torch.float32)
    inner = (..., slice(12, -12), slice(12, -12))
    torch.testing.assert_close(run(special, [frame])[0][inner], run(before, [frame])[0][inner], rtol=1e-3, atol=1e-4)

    weights = train_network(task)
    assert f"wskp3: specialised to {grey}, left out albedo\n" in capsys.readouterr().out
    assert json.loads(metadata(weights)["constants"]) == special.constants
    assert tensors(weights)["network.0.branches.2.weight"].shape == (24, 7, 5, 5)
    trained = load("wskp3", weights, torch.float32)
    assert torch.isfinite(run(trained, [frame])[0]).all()
    with pytest.raises(BadInput, match="albedo is not"):  # test clips are as they were
        run(trained, [read_frame(Dataset(grey).clips("test")[0], 0, trained.reads)])
    with pytest.raises(BadInput, match="another recipe, seed, data set or start"):
        train_network(replace(task, specialised=False))
    # These weights can be trained further with such scenes only.
    for specialised in (True, False):
        again = Training(short("wskp3", grey, tmp_path / "again", start=weights, specialised=specialised))
        assert again.judged.denoiser.constants == {"albedo": GREY["value"]}
    with pytest.raises(BadInput, match=r"specialised to scenes whose albedo is \[0.5, 0.5, 0.5\] everywhere"):
        Training(short("wskp3", tiny, tmp_path / "tiny", start=weights))


@pytest.mark.slow
def test_a_network_is_specialised_from_scratch_too(tiny, tmp_path):
    """All surfaces of the tiny data set are diffuse."""
    task = short("rae", tiny, tmp_path, specialised=True)
    weights = train_network(task)
    assert json.loads(metadata(weights)["constants"]) == {"roughness": [1.0]}
    assert tensors(weights)["network.first.weight"].shape == (32, 6, 3, 3)
    assert weights == folder_of(tmp_path, "rae") / WEIGHTS_FILE


@pytest.mark.slow
def test_where_all_inputs_vary_none_is_left_out(capsys, tiny, tmp_path):
    general = Training(short_task("wskp6", tiny, tmp_path / "general"))
    special = Training(short("wskp6", tiny, tmp_path / "special", specialised=True))
    assert special.facts == general.facts and special.judged.denoiser.constants == {}
    train_network(short("wskp6", tiny, tmp_path / "special", specialised=True))
    assert "left out nothing: all of its inputs vary" in capsys.readouterr().out
    with pytest.raises(BadInput, match="without --specialise"):
        train_network(replace(short_task("one", tiny, tmp_path), specialised=True))


def test_the_campaign_goes_on_from_weights_that_denoise(tiny):
    clip = Dataset(tiny).clips("test")[0]
    shipped = load("one", shipped_weights("one"), torch.float32)
    (output,) = run(shipped, [read_frame(clip, 0, shipped.reads)])
    truth = torch.from_numpy(clip.reference(0).mean(axis=0)).movedim(-1, 0)
    noisy = torch.from_numpy(clip.noisy(0)).movedim(-1, 0)
    assert (output[0] - truth).square().mean() < 0.2 * (noisy - truth).square().mean()
