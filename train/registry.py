"""The trainings that have names."""

from functools import partial
from pathlib import Path

from datasets.clip import Dataset
from models.registry import create
from train.recipes import recipe_for
from train.task import Task, run_folder


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
