"""Short trainings, in this process or in one of its own, and what they leave."""

import json
import resource
import signal
import subprocess
import sys
from ast import literal_eval
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from torch import Tensor

from datasets.frame import Frame
from models.history.running_scale import RunningScale
from models.registry import create
from models.weights import save_weights
from train.loop import train_network
from train.precision import FLOAT32
from train.recipes import task_for
from train.task import WEIGHTS_FILE, Task, run_folder

# Two to ten steps of the tiny budget.
ONE_EPOCH: dict[str, Any] = {"epochs": 1}
SHORT = {"rae": ONE_EPOCH, "wskp6": {"epochs": 2, "crops": (2, 1)}, "ntd": ONE_EPOCH, "one": ONE_EPOCH}


def short_task(
    name: str, data: Path, runs: Path, seed: int = 0, precision: str | None = FLOAT32, **recipe: Any
) -> Task:
    """A training of a few steps, or with other changes to its recipe."""
    task = task_for(name, data, runs, "tiny")
    return replace(task, recipe=replace(task.recipe, **(recipe or SHORT[name])), seed=seed, precision=precision)


def fresh_weights(name: str, path: Path, seed: int = 0) -> Path:
    """Weights that were not trained."""
    torch.manual_seed(seed)
    save_weights(create(name), name, {}, path)
    return path


def folder_of(runs: Path, name: str) -> Path:
    """Where a short training is kept."""
    return run_folder(runs, name, "tiny")


def tensors(weights: Path) -> dict[str, torch.Tensor]:
    with safe_open(weights, "pt") as file:
        return {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict


def metadata(weights: Path) -> dict[str, str]:
    with safe_open(weights, "pt") as file:
        return dict(file.metadata())


def makers_of(weights: Path) -> list[dict[str, Any]]:
    return list(json.loads(metadata(weights)["made_by"]))


def same_weights(a: Path, b: Path) -> bool:
    """Whether two trainings, given their folders, ended with the same weights bit for bit."""
    x, y = (tensors(folder / WEIGHTS_FILE) for folder in (a, b))
    return x.keys() == y.keys() and all(torch.equal(x[key], y[key]) for key in x)


def predict_as(
    monkeypatch: pytest.MonkeyPatch, denoiser: Any, output: Callable[[Frame, Any], Tensor]
) -> list[tuple[Tensor, RunningScale]]:
    """Let a network predict `output` of each frame and state; it is listed with the scale there."""
    genuine = denoiser.predict
    predicted = []

    def predict(frame: Frame, state: Any) -> tuple[Tensor, Any]:
        _, state = genuine(frame, state)
        predicted.append((output(frame, state), state.scale))
        return predicted[-1][0], state

    monkeypatch.setattr(denoiser, "predict", predict)
    return predicted


@contextmanager
def full_disk(largest: int) -> Iterator[None]:
    """No file can grow over `largest` bytes: it stands in for a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, limits[1]))
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def as_command(name: str, data: Path, runs: Path, **recipe: Any) -> list[str]:
    """The arguments after `python` or `torchrun` of a short training that writes a checkpoint after every step."""
    return ["-m", "tests.helpers.training", name, str(data), str(runs), repr(recipe)]


def start_training(name: str, data: Path, runs: Path, **recipe: Any) -> "subprocess.Popen[bytes]":
    return subprocess.Popen([sys.executable, *as_command(name, data, runs, **recipe)], stderr=subprocess.DEVNULL)


def main(name: str, data: str, runs: str, recipe: str) -> None:
    train_network(short_task(name, Path(data), Path(runs), **literal_eval(recipe)), save_seconds=0.0)


if __name__ == "__main__":
    main(*sys.argv[1:])
