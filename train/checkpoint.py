"""Checkpoints: what an interrupted training needs to resume."""

import io
from pathlib import Path
from typing import Any

import torch

from errors import BadInput
from files import write_file

CHECKPOINT_FILE = "checkpoint.pt"

Checkpoint = dict[str, Any]


def load_checkpoint(folder: Path) -> Checkpoint:
    """The checkpoint of the training in `folder`; empty where there is none. Raises BadInput where it is damaged."""
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return {}
    try:
        return dict(torch.load(path, weights_only=True, map_location="cpu"))
    except OSError:
        raise
    except Exception as error:  # a damaged pickle may fail in any way
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise BadInput(f"{path} is damaged ({reason}): delete {folder}") from None


def save_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Write atomically: a full disk or a kill leaves the previous one."""
    buffer = io.BytesIO()
    torch.save(checkpoint, buffer)
    write_file(folder / CHECKPOINT_FILE, buffer.getvalue())
