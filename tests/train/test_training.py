"""Training steps: gradients of parts add up, bad steps are skipped, weights are averaged, precision is measured."""

import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from errors import BadInput
from tests.helpers.training import full_disk, short_task, tensors
from train.loop import train_network
from train.losses.network_loss import NetworkLoss
from train.training import BEST_FILE, CHECKPOINT_FILE, MAX_SKIPPED_IN_A_ROW, Training, average_decay, update_average


def test_gradients_of_parts_add_up_to_those_of_the_batch(tiny, tmp_path):
    """Four sequences at once, and one by one: the same loss and weights up to rounding."""
    task = short_task("rae", tiny, tmp_path)
    results = []
    for micro_batch in (4, 1):
        training = Training(replace(task, micro_batch=micro_batch))
        assert training.parts == 4 // micro_batch
        steps = training.steps()
        losses = [next(steps)["loss"] for _ in range(2)]
        results.append((losses, torch.cat([p.detach().flatten() for p in training.loss.parameters()])))
    (losses, weights), (other_losses, other_weights) = results
    assert other_losses == pytest.approx(losses, rel=1e-4)
    assert torch.dist(other_weights, weights) < 1e-3 * weights.norm()


def test_what_cannot_be_trained_with_is_refused_before_anything_is_written(tiny, tmp_path):
    task = short_task("rae", tiny, tmp_path)
    with pytest.raises(BadInput, match="use 1 or more"):
        train_network(replace(task, micro_batch=0))
    with pytest.raises(BadInput, match="too few or too small to train on"):
        train_network(replace(task, recipe=replace(task.recipe, crop=65)))
    with pytest.raises(BadInput, match="a batch of 4 cannot be shared by 3 processes"):
        task.check(processes=3)
    copy = shutil.copytree(tiny, tmp_path / "copy")
    shutil.rmtree(copy / "val" / "cornell_box")
    with pytest.raises(BadInput, match="'val' are missing"):
        train_network(short_task("rae", copy, tmp_path))
    assert not (tmp_path / "train").exists()


def make_finite(monkeypatch, *finite: bool) -> None:
    """Whether the loss of each step is to be finite; the last is of all that follow."""
    genuine = NetworkLoss.forward
    waiting = list(finite)

    def forward(self, batch):
        value, parts = genuine(self, batch)
        keep = waiting.pop(0) if len(waiting) > 1 else waiting[0]
        return (value if keep else value * math.nan), parts

    monkeypatch.setattr(NetworkLoss, "forward", forward)


def test_steps_that_are_not_finite_are_skipped_and_counted(tiny, tmp_path, monkeypatch):
    make_finite(monkeypatch, True, False, True)
    training = Training(short_task("rae", tiny, tmp_path, epochs=2))
    steps = training.steps()
    next(steps)
    next(steps)
    assert training.position.skipped == 1 and training.position.skipped_in_a_row == 1
    next(steps)
    assert training.position.skipped == 1 and training.position.skipped_in_a_row == 0
    assert all(torch.isfinite(p).all() for p in training.loss.parameters())
    # A finite loss with a gradient that is not is skipped too.
    before = [p.clone() for p in training.loss.parameters()]
    hook = next(training.loss.parameters()).register_hook(lambda gradient: gradient * math.nan)
    next(steps)
    hook.remove()
    assert training.position.skipped == 2
    assert all(torch.equal(p, q) for p, q in zip(before, training.loss.parameters(), strict=True))


def test_long_gradients_are_cut_and_their_length_is_noted(tiny, tmp_path):
    """With plain descent the step is the rate times the cut gradient, by its length."""
    task = short_task("rae", tiny, tmp_path)
    moved = {}
    noted = {}
    for clip in (None, 1.0):
        training = Training(replace(task, recipe=replace(task.recipe, clip=clip)))
        training.optimiser = torch.optim.SGD(training.loss.parameters(), lr=1.0)
        before = torch.cat([p.detach().flatten().clone() for p in training.loss.parameters()])
        step = next(training.steps())
        after = torch.cat([p.detach().flatten() for p in training.loss.parameters()])
        moved[clip] = torch.dist(after, before).item() / step["learning_rate"]
        noted[clip] = step["gradient_norm"]
    assert noted[None] == pytest.approx(moved[None], rel=1e-3) and noted[None] > 2
    assert noted[1.0] == pytest.approx(noted[None], rel=1e-4) and moved[1.0] == pytest.approx(1, rel=0.01)


def test_a_loss_that_is_not_finite_is_never_the_best(tiny, tmp_path):
    training = Training(short_task("rae", tiny, tmp_path))
    training.keep_best(math.nan)
    assert not training.task.folder.exists()


def test_a_training_that_only_skips_is_refused(tiny, tmp_path, monkeypatch):
    make_finite(monkeypatch, False)
    training = Training(short_task("rae", tiny, tmp_path, epochs=2))
    training.position.skipped_in_a_row = MAX_SKIPPED_IN_A_ROW - 2
    steps = training.steps()
    next(steps)
    with pytest.raises(BadInput, match=r"not finite in 20 steps in a row.*--precision float32"):
        next(steps)


def test_full_disk_is_one_clear_line_and_keeps_the_earlier_checkpoint(tiny, tmp_path):
    training = Training(short_task("rae", tiny, tmp_path))
    folder = training.task.folder
    folder.mkdir(parents=True)
    training.save()
    before = (folder / CHECKPOINT_FILE).read_bytes()
    with full_disk(1_000_000):
        with pytest.raises(OSError, match="File too large"):
            training.save()
        with pytest.raises(OSError, match="File too large"):
            training.keep_best(0.5)
    assert (folder / CHECKPOINT_FILE).read_bytes() == before
    assert [path.name for path in folder.iterdir()] == [CHECKPOINT_FILE] and not (folder / BEST_FILE).exists()


def test_average_by_hand():
    average = nn.Linear(1, 1, bias=False)
    network = nn.Linear(1, 1, bias=False)
    average.weight.data.fill_(2.0)
    network.weight.data.fill_(10.0)
    update_average(average, network, 0.75)
    assert average.weight.item() == 4.0 and network.weight.item() == 10.0


def test_average_forgets_the_beginning_and_spans_what_it_should():
    """The weights of update i in the average after n, from the decays alone."""
    decays = [average_decay(n, 50) for n in range(1, 1001)]
    assert decays[:2] == pytest.approx([2 / 11, 3 / 12]) and decays[-1] == pytest.approx(0.98)
    weights = [(1 - decay) * np.prod(decays[n:]) for n, decay in enumerate(decays, start=1)]
    ages = [len(weights) - n for n in range(1, len(weights) + 1)]
    assert sum(weights) == pytest.approx(1, abs=1e-6)
    assert sum(w * age for w, age in zip(weights, ages, strict=True)) == pytest.approx(49, rel=0.01)
    assert average_decay(5, 0.5) == 0  # over less than an update: the weights themselves


def test_the_average_is_what_is_validated_and_saved(tiny, tmp_path):
    without = Training(short_task("wskp6", tiny, tmp_path, epochs=1, crops=(2, 1), average=0.0))
    assert without.judged is without.loss.module
    training = Training(short_task("wskp6", tiny, tmp_path, epochs=2, crops=(2, 1), average=0.5))
    first = [p.clone() for p in training.judged.parameters()]
    for index, _ in enumerate(training.steps(), start=1):
        decay = min(1 - 1 / (0.5 * training.total), (1 + index) / (10 + index))
        now = [p.detach() for p in training.loss.parameters()]
        first = [decay * a + (1 - decay) * b for a, b in zip(first, now, strict=True)]
    assert training.total == index > 4
    for expected, kept, last in zip(first, training.judged.parameters(), now, strict=True):
        torch.testing.assert_close(kept.detach(), expected)
        assert not torch.allclose(kept, last, rtol=1e-5)
    validation = training.validate()
    training.task.folder.mkdir(parents=True)
    training.keep_best(validation)
    saved = tensors(training.task.folder / BEST_FILE)
    assert all(torch.equal(saved[name], p) for name, p in training.judged.denoiser.state_dict().items())
    training.judged = training.loss.module
    assert training.validate() != validation
