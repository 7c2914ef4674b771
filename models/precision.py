"""Which floating-point precision to train in: measured on this machine, not guessed."""

import time

import torch
from torch import nn

WORTHWHILE = 1.2  # bfloat16 must be this much faster to be used


def step_seconds(device: torch.device, bfloat16: bool) -> float:
    """Best of three times of a small convolutional forward and backward pass."""
    layer = nn.Conv2d(64, 64, 3, padding=1).to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    x = torch.rand(4, 64, 64, 64, device=device).contiguous(memory_format=torch.channels_last)
    best = float("inf")
    for _ in range(4):  # the first also warms up
        start = time.perf_counter()
        with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16):
            total = layer(x).float().sum()
        total.backward()
        float(total.detach())  # waits for a GPU
        best = min(best, time.perf_counter() - start)
    return best


def fastest_precision(device: torch.device) -> str:
    """Fabric's name of it: bf16-mixed where the processor is fast at it, else 32-true."""
    return "bf16-mixed" if step_seconds(device, False) > WORTHWHILE * step_seconds(device, True) else "32-true"
