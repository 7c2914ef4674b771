"""The trainings that have names."""

from functools import partial
from pathlib import Path

from datasets.clip import Dataset
from models.registry import create, require_shipped
from train.recipes import recipe_for
from train.task import Task, run_folder

SHIPPED = "weights"  # in place of a file: those that are shipped


def start_file(name: str, start: str | None) -> Path | None:
    """The weights that a training of a network is to begin with. Raises BadInput where none are shipped."""
    if start == SHIPPED:
        return require_shipped(name)
    return Path(start) if start else None


def task_for(name: str, data: Path, runs: Path, budget: str) -> Task:
    """The training of a denoiser in a budget. Raises BadInput for an unknown name or budget, or no data."""
    return Task(
        name=name,
        create=partial(create, name),
        recipe=recipe_for(name, budget),
        budget=budget,
        data=Dataset(data),
        folder=run_folder(runs, name, budget),
        cache=runs / "accumulated",
    )
