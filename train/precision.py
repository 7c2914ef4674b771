"""Precision, devices and processes of a training, by Lightning Fabric."""

import os

import torch
from lightning_fabric import Fabric

FLOAT32 = "float32"
BFLOAT16 = "bfloat16"  # by autocast; the weights are float32 all the same
FABRIC_NAMES = {FLOAT32: "32-true", BFLOAT16: "bf16-mixed"}


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
