"""What is trained, on what, and where that is kept."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from datasets.clip import Dataset
from errors import BadInput
from models.denoiser import Denoiser
from train.recipe import Recipe
from train.sequences import check_fits

WEIGHTS_FILE = "weights.safetensors"


def run_folder(runs: Path, name: str, budget: str) -> Path:
    """Where the training of a network in a budget keeps its checkpoint, curves and weights."""
    return runs / "train" / f"{name}-{budget}"


@dataclass(frozen=True)
class Task:
    """What is trained, on what, and where that is kept. `create` makes the network with fresh weights.

    `start` has the weights to begin with instead; `specialised` networks do without what does not vary in the data.
    """

    name: str
    create: Callable[[], Denoiser]
    recipe: Recipe
    budget: str
    data: Dataset
    folder: Path  # of this training
    cache: Path  # of accumulated frames, which trainings share
    seed: int = 0
    precision: str | None = None  # by default the fastest here
    micro_batch: int | None = None  # items in memory together; by default what fits a few gigabytes
    start: Path | None = None
    specialised: bool = False

    def check(self, processes: int) -> None:
        """Raises BadInput where this data set, or so many processes, cannot be trained with."""
        if self.recipe.batch % processes:
            raise BadInput(
                f"a batch of {self.recipe.batch} cannot be shared by {processes} processes: start a divisor of "
                f"{self.recipe.batch}"
            )
        if self.micro_batch is not None and self.micro_batch < 1:
            raise BadInput(f"a micro-batch of {self.micro_batch} items is none: use 1 or more")
        check_fits(self.data.clips("train"), self.recipe.frames(training=True), self.recipe.crop)
        check_fits(self.data.clips("val"), self.recipe.frames(training=False), self.recipe.crop)
