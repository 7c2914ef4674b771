"""Precision, devices and processes of a training: Lightning Fabric, and which precision is faster here."""

import os
import time
from functools import partial

import torch
from lightning_fabric import Fabric

from models.spec import MIN_SPEEDUP
from timing import device_clock, take_turns, thread_count
from train.crops import AnyBatch
from train.losses.network_loss import NetworkLoss

FLOAT32 = "float32"
BFLOAT16 = "bfloat16"  # by autocast; the weights are float32 all the same
FABRIC_NAMES = {FLOAT32: "32-true", BFLOAT16: "bf16-mixed"}
STEP_TURNS = 3


def fabric_here(precision: str = FLOAT32) -> Fabric:
    """Fabric for this machine: one GPU or the CPU; under torchrun as many processes as that has started (DDP)."""
    here = int(os.environ.get("LOCAL_WORLD_SIZE", 1))
    world = int(os.environ.get("WORLD_SIZE", 1))
    fabric = Fabric(
        accelerator="cuda" if torch.cuda.is_available() else "cpu",
        strategy="ddp" if world > 1 else "auto",
        devices=here,
        num_nodes=world // here,
        precision=FABRIC_NAMES[precision],  # type: ignore[arg-type]
    )
    fabric.launch()
    return fabric


def forward_and_backward(loss: NetworkLoss, batch: AnyBatch, device: str, precision: str) -> None:
    with torch.autocast(device, torch.bfloat16, enabled=precision == BFLOAT16):
        value, _ = loss(batch)
    value.backward()
    float(value.detach())  # waits for a GPU
    loss.zero_grad()


def fastest_precision(loss: NetworkLoss, batch: AnyBatch, device: str) -> str:
    """bfloat16 where that makes a step at least MIN_SPEEDUP times faster, by the best of some turns; else float32.

    On processors one thread computes, and only its own time counts: on a busy machine the wall clock measures waiting.
    """
    loss = loss.to(device)
    batch = batch.to(device)
    work = {precision: partial(forward_and_backward, loss, batch, device, precision) for precision in FABRIC_NAMES}
    clock = time.process_time if device == "cpu" else partial(device_clock, device)
    with thread_count(1):
        seconds = take_turns(work, STEP_TURNS, clock=clock, label="measuring precisions")
    return BFLOAT16 if min(seconds[FLOAT32]) > MIN_SPEEDUP * min(seconds[BFLOAT16]) else FLOAT32
