"""Checkpoints: what a training needs to go on where it stood."""

import io
from pathlib import Path
from typing import Any

import torch

from errors import BadInput
from files import write_file
from train.precision import BFLOAT16, FLOAT32

CHECKPOINT_FILE = "checkpoint.pt"
OLD_PRECISIONS = {"32-true": FLOAT32, "bf16-mixed": BFLOAT16}  # as earlier versions wrote them

Checkpoint = dict[str, Any]


def load_checkpoint(folder: Path) -> Checkpoint:
    """The checkpoint of the training in `folder`; empty where there is none. Raises BadInput where it is damaged."""
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return {}
    try:
        checkpoint = dict(torch.load(path, weights_only=True, map_location="cpu"))
        precision = checkpoint["precision"]
    except OSError:
        raise
    except Exception as error:  # a damaged pickle may fail in any way
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise BadInput(f"{path} is damaged ({reason}): delete {folder}") from None
    return checkpoint | {"precision": OLD_PRECISIONS.get(precision, precision)}


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write atomically: a full disk or a kill leaves the previous one."""
    buffer = io.BytesIO()
    torch.save(checkpoint, buffer)
    write_file(folder / CHECKPOINT_FILE, buffer.getvalue())
