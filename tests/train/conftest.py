"""Clips to train on, and a finished training for tests that look at what it left or damage a copy of it."""

import shutil
from pathlib import Path

import pytest

from datasets.clip import Clip, Dataset
from tests.helpers.shared import made_once
from tests.helpers.training import folder_of, short_task
from train.loop import train_network


@pytest.fixture(scope="session")
def clips(tiny: Path) -> list[Clip]:
    return Dataset(tiny).clips("train")


@pytest.fixture(scope="session")
def trained_runs(tiny: Path, shared: Path) -> Path:
    """Where a short training of rae is kept. Read only."""
    return made_once(shared / "trained", lambda runs: train_network(short_task("rae", tiny, runs)))


@pytest.fixture
def trained_copy(trained_runs: Path, tmp_path: Path) -> Path:
    """A copy of the training's own folder, in tmp_path."""
    return Path(shutil.copytree(folder_of(trained_runs, "rae"), folder_of(tmp_path, "rae")))
