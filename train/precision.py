"""Which floating-point precision to train in: measured on the step itself, not guessed."""

import time
from typing import Any

import torch

from train.losses import NetworkLoss

WORTHWHILE = 1.1  # bfloat16 must be this much faster to be used
REPEATS = 3  # of which the first warms up


def step_seconds(loss: NetworkLoss, batch: Any, device: str, bfloat16: bool) -> float:
    """Best time of a forward and backward pass. Leaves no gradients."""
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        with torch.autocast(device, torch.bfloat16, enabled=bfloat16):
            value, _ = loss(batch)
        value.backward()
        float(value.detach())  # waits for a GPU
        times.append(time.perf_counter() - start)
        loss.zero_grad()
    return min(times[1:])


def fastest_precision(loss: NetworkLoss, batch: Any, device: str) -> str:
    """Fabric's name of it: bf16-mixed where that makes the step worthwhile faster, else 32-true."""
    loss, batch = loss.to(device), batch.to(device)
    seconds = [step_seconds(loss, batch, device, bfloat16) for bfloat16 in (False, True)]
    return "bf16-mixed" if seconds[0] > WORTHWHILE * seconds[1] else "32-true"
