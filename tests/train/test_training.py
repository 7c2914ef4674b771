"""Training steps: gradients of parts add up, what is not finite is skipped, and a full disk is survived."""

import math
import shutil
from dataclasses import replace

import pytest
import torch

from errors import BadInput
from tests.helpers.training import full_disk, short_task
from train.checkpoint import CHECKPOINT_FILE
from train.loop import train_network
from train.losses.network_loss import NetworkLoss
from train.training import BEST_FILE, MAX_SKIPPED_IN_A_ROW, Training


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
    for losses, weights in results[1:]:
        assert losses == pytest.approx(results[0][0], rel=1e-4)
        assert torch.dist(weights, results[0][1]) < 1e-3 * results[0][1].norm()


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
    """With plain descent the step is the rate times the cut gradient: its length tells."""
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
