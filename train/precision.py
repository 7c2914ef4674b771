"""Which floating-point precision to train in: measured on the step itself, not guessed."""

from functools import partial
from typing import Any

import torch

from timing import take_turns
from train.losses.network_loss import NetworkLoss

FLOAT32 = "float32"
BFLOAT16 = "bfloat16"  # by autocast; the weights are float32 all the same

WORTHWHILE = 1.1  # bfloat16 must be this many times faster to be used


def forward_and_backward(loss: NetworkLoss, batch: Any, device: str, precision: str) -> None:
    """Compute the gradients of a batch, and drop them."""
    with torch.autocast(device, torch.bfloat16, enabled=precision == BFLOAT16):
        value, _ = loss(batch)
    value.backward()
    float(value.detach())  # waits for a GPU
    loss.zero_grad()


def fastest_precision(loss: NetworkLoss, batch: Any, device: str) -> str:
    """bfloat16 where that makes a step WORTHWHILE times faster, by the best of two measured rounds; else float32."""
    loss = loss.to(device)
    batch = batch.to(device)
    work = {
        FLOAT32: partial(forward_and_backward, loss, batch, device, FLOAT32),
        BFLOAT16: partial(forward_and_backward, loss, batch, device, BFLOAT16),
    }
    seconds = take_turns(work, measured=2, label="measuring precisions")
    return BFLOAT16 if min(seconds[FLOAT32]) > WORTHWHILE * min(seconds[BFLOAT16]) else FLOAT32
