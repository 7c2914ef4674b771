"""The precision of a training is measured."""

import time

import pytest
import torch

from train.precision import BFLOAT16, FLOAT32, fastest_precision


class SlowIn(torch.nn.Module):
    """A loss that computes for long in one precision, and waits for longer in the other, as on a busy machine."""

    def __init__(self, precision: str):
        super().__init__()
        self.precision = precision
        self.weight = torch.nn.Parameter(torch.ones(()))

    def forward(self, batch):
        if torch.is_autocast_enabled("cpu") == (self.precision == BFLOAT16):
            end = time.process_time() + 0.02
            while time.process_time() < end:
                pass
        else:
            time.sleep(0.05)
        return self.weight * 1, {}


class Nothing:
    def to(self, _):
        return self


@pytest.mark.parametrize("slow, fast", [(BFLOAT16, FLOAT32), (FLOAT32, BFLOAT16)])
def test_the_faster_precision_wins_however_busy_the_machine(slow, fast):
    loss = SlowIn(slow)
    threads = torch.get_num_threads()
    assert fastest_precision(loss, Nothing(), "cpu") == fast
    assert loss.weight.grad is None and torch.get_num_threads() == threads
