"""`onespp bench loading`: reading training sequences, next to training on them, and the memory that reading takes."""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import count, cycle
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from tabulate import tabulate
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.info import size_of
from eval.bench.memory import alone, status_mb
from eval.bench.output import bench_folder
from files import write_json
from models.registry import create
from timing import device_clock, take_turns
from train.data import Items, items, loader, micro_batches
from train.recipe import Recipe
from train.recipes import recipe_for
from train.registry import task_for
from train.training import Training

FASTEST_NETWORK = "rae"  # the one whose training consumes the most pixels a second
WORKERS = (0, 1, 2)  # processes that load
TIMED_ROUNDS = 5  # of epochs and a training step, besides a first one that warms up; the median counts
EPOCH_SEQUENCES = 300  # a measured epoch has, at least
DATASET_BYTES = (0.1e9, 5e9)  # of the data sets whose memory is compared
TRAINING = "training"


@dataclass(frozen=True)
class Rate:
    """How fast sequences are loaded or trained on."""

    what: str
    sequences_s: float
    megapixels_s: float
    to_training: float  # times the rate of training


@dataclass(frozen=True)
class EpochMemory:
    """Anonymous memory in MB of a process that loads a data set; None where the system does not tell."""

    dataset_gb: float
    clips: int
    before_mb: float | None
    after_mb: float | None

    def line(self) -> dict[str, Any]:
        """As it stands in the table and in loading.json."""
        return {
            "data set GB": self.dataset_gb,
            "clips": self.clips,
            "RssAnon MB before": self.before_mb,
            "after an epoch": self.after_mb,
        }


def bench_loading(
    data: Path,
    runs: Path,
    budget: str,
    workers: Sequence[int] = WORKERS,
    measured: int = TIMED_ROUNDS,
    sequences: int = EPOCH_SEQUENCES,
    sizes: Sequence[float] = DATASET_BYTES,
) -> str:
    """Measure on the training clips of `data`: tables, and RUNS/bench/loading.json.

    While it works it needs as much room in `runs` as the largest of `sizes`, in bytes: 5 GB.
    Raises BadInput for unusable data or an unknown budget.
    """
    recipe = recipe_for(FASTEST_NETWORK, budget)
    clips = Dataset(data).clips("train")
    folder = bench_folder(runs)
    with TemporaryDirectory() as temporary:
        training = Training(task_for(FASTEST_NETWORK, data, Path(temporary), budget))
        rates = measure_rates(training, clips, workers, measured, sequences)
    memory = [memory_of(clips, recipe, folder, size).line() for size in tqdm(sizes, "memory", leave=False)]
    trainer = f"{FASTEST_NETWORK}, {training.precision}, {training.fabric.device.type}"
    speed = [asdict(rate) for rate in rates]
    write_json(folder / "loading.json", {"profile": budget, "training": trainer, "speed": speed, "memory": memory})
    heads = {"to_training": "times training", "what": trainer, "sequences_s": "sequences/s", "megapixels_s": "Mpixel/s"}
    speed_table = tabulate(speed, heads, floatfmt=".3g")
    return f"{speed_table}\n\n{tabulate(memory, 'keys', floatfmt='.2f', missingval='-')}"


def measure_rates(
    training: Training, clips: list[Clip], workers: Sequence[int], measured: int, sequences: int
) -> list[Rate]:
    """Augmented sequences a second: as a training gets them, with each number of workers, and as it trains on them.

    The start of the workers counts as loading, and loading does not count as training.
    """
    recipe = training.recipe
    assert recipe.crop
    steps = -(-sequences // recipe.batch)
    work = {f"loading, {processes} workers": loading_epochs(clips, recipe, steps, processes) for processes in workers}
    clock = partial(device_clock, training.fabric.device.type)
    seconds = take_turns(work | {TRAINING: training_steps(training)}, measured, clock=clock, label="loading")
    rates = {what: steps * recipe.batch / median(seconds[what]) for what in work}
    rates[TRAINING] = recipe.batch / median(seconds[TRAINING])
    pixels = recipe.length * recipe.crop**2
    return [Rate(what, rate, rate * pixels / 1e6, rate / rates[TRAINING]) for what, rate in rates.items()]


def sequences_of(clips: list[Clip], recipe: Recipe) -> Items:
    return items(clips, recipe, create(FASTEST_NETWORK), True, 0, Path())  # sequences need no cache


def loading_epochs(clips: list[Clip], recipe: Recipe, steps: int, workers: int) -> Callable[[], None]:
    """A function that loads the next epoch of so many steps."""
    sequences = sequences_of(clips, recipe)
    batches = micro_batches(0, steps, recipe.batch, recipe.batch)
    epochs = count()

    def load() -> None:
        sequences.set_epoch(next(epochs))
        for _ in loader(sequences, batches, workers):
            pass

    return load


def training_steps(training: Training) -> Callable[[], object]:
    """A function that takes a training step with a batch that is in memory already."""
    batch = training.recipe.batch
    batches = cycle(list(loader(training.items, micro_batches(0, 2, batch, batch))))
    return lambda: training.step([next(batches)])


def memory_of(clips: list[Clip], recipe: Recipe, folder: Path, size: float) -> EpochMemory:
    """Memory of a process of its own before and after an epoch over `size` bytes of copies of the clips."""
    with TemporaryDirectory(dir=folder) as temporary:
        copies = list(copy_clips(clips, Path(temporary), size))
        total = sum(size_of(copy) for copy in copies)
        before, after = alone(anonymous_memory, copies, recipe)
    return EpochMemory(total / 1e9, len(copies), before, after)


def copy_clips(clips: list[Clip], folder: Path, size: float) -> Iterator[Path]:
    total = 0
    for index, clip in enumerate(cycle(clips)):
        if total >= size:
            return
        total += size_of(clip.path)
        yield Path(shutil.copytree(clip.path, folder / f"{index:05d}"))


def anonymous_memory(paths: list[Path], recipe: Recipe) -> tuple[float | None, float | None]:
    """Megabytes before and after an epoch, without the pages of mapped files, which the system can take back."""
    sequences = sequences_of([Clip(path) for path in paths], recipe)
    steps = max(1, len(sequences) // recipe.batch)
    batches = iter(loader(sequences, micro_batches(0, steps, recipe.batch, recipe.batch)))
    next(batches)
    before = status_mb("RssAnon")
    for _ in batches:
        pass
    return before, status_mb("RssAnon")
