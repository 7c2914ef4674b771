"""Which floating-point precision to train in: measured on the step itself, not guessed."""

import time
from functools import partial
from typing import Any

import torch

from models.fastest import MIN_SPEEDUP
from timing import device_clock, take_turns, thread_count
from train.losses.network_loss import NetworkLoss

FLOAT32 = "float32"
BFLOAT16 = "bfloat16"  # by autocast; the weights are float32 all the same

TURNS = 3


def forward_and_backward(loss: NetworkLoss, batch: Any, device: str, precision: str) -> None:
    """Compute the gradients of a batch, and drop them."""
    with torch.autocast(device, torch.bfloat16, enabled=precision == BFLOAT16):
        value, _ = loss(batch)
    value.backward()
    float(value.detach())  # waits for a GPU
    loss.zero_grad()


def fastest_precision(loss: NetworkLoss, batch: Any, device: str) -> str:
    """bfloat16 where that makes a step at least MIN_SPEEDUP times faster, by the best of some turns; else float32.

    On processors one thread computes, and only its own time counts: on a busy machine the wall clock measures waiting.
    """
    loss = loss.to(device)
    batch = batch.to(device)
    work = {
        FLOAT32: partial(forward_and_backward, loss, batch, device, FLOAT32),
        BFLOAT16: partial(forward_and_backward, loss, batch, device, BFLOAT16),
    }
    clock = time.process_time if device == "cpu" else partial(device_clock, device)
    with thread_count(1):
        seconds = take_turns(work, TURNS, clock=clock, label="measuring precisions")
    return BFLOAT16 if min(seconds[FLOAT32]) > MIN_SPEEDUP * min(seconds[BFLOAT16]) else FLOAT32
