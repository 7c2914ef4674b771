"""The average of the weights: by hand, over a training, through an interruption, and as what is judged and kept."""

import numpy as np
import pytest
import torch
from torch import nn

from tests.helpers.training import short_task, tensors
from train.checkpoint import load_checkpoint
from train.training import BEST_FILE, Training, average_decay, update_average


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


def test_a_resumed_training_continues_its_average(tiny, tmp_path):
    without = Training(short_task("wskp6", tiny, tmp_path, epochs=1, crops=(2, 1), average=0.0))
    assert without.judged is without.loss.module
    task = short_task("wskp6", tiny, tmp_path, epochs=2, crops=(2, 1), average=0.5)
    whole = Training(task)
    steps = whole.steps()
    for _ in range(3):
        next(steps)
    task.folder.mkdir(parents=True)
    whole.save()
    resumed = Training(task, load_checkpoint(task.folder))
    list(steps)
    list(resumed.steps())
    for a, b in zip(whole.judged.parameters(), resumed.judged.parameters(), strict=True):
        assert torch.equal(a, b)
