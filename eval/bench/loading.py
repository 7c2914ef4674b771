"""How fast training sequences come from disk, next to how fast they are trained on, and in how much memory."""

import multiprocessing
import re
import shutil
import time
from collections.abc import Callable, Iterator
from itertools import count, cycle
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from tabulate import tabulate
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.info import size_of
from files import write_json
from models.registry import create
from train.data import Items, items, loader, micro_batches
from train.recipe import Recipe
from train.recipes import recipe_for
from train.registry import task_for
from train.training import Training

FASTEST = "rae"  # the network whose training consumes the most pixels a second
WORKERS = (0, 1, 2)
REPEATS = 5  # of each measurement, besides a first one that warms up; the median counts
SEQUENCES = 300  # a measured epoch has, at least
SIZES = (0.1e9, 5e9)  # bytes of the data sets whose memory is compared


def bench_loading(data: Path, runs: Path, profile: str) -> str:
    """Measure on the training clips of `data`; returns tables and writes RUNS/bench/loading.json.

    Needs 5 GB of room in `runs` while it works. Raises BadInput for unusable data or an unknown profile.
    """
    recipe, clips = recipe_for(FASTEST, profile), Dataset(data).clips("train")
    folder = runs / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    rates: dict[str, float] = {}
    for workers in tqdm(WORKERS, "loading", leave=False):
        rates[f"loading, {workers} workers"] = loading_rate(clips, recipe, workers)
    trainer, rates["training"] = training_rate(data, profile)
    memory = [memory_of(clips, recipe, folder, size) for size in tqdm(SIZES, "memory", leave=False)]
    assert recipe.crop
    pixels = recipe.length * recipe.crop**2
    speeds = [
        {
            "what": what,
            "sequences_s": rate,
            "megapixels_s": rate * pixels / 1e6,
            "to_training": rate / rates["training"],
        }
        for what, rate in rates.items()
    ]
    write_json(folder / "loading.json", {"profile": profile, "training": trainer, "speed": speeds, "memory": memory})
    heads = {"to_training": "times training", "what": trainer, "sequences_s": "sequences/s", "megapixels_s": "Mpixel/s"}
    return "\n\n".join([tabulate(speeds, heads, floatfmt=".3g"), tabulate(memory, "keys", floatfmt=".2f")])


def median_seconds(work: Callable[[], object]) -> float:
    """Median time of a call, after one that does not count."""
    seconds = []
    for _ in range(1 + REPEATS):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return median(seconds[1:])


def sequences_of(clips: list[Clip], recipe: Recipe) -> Items:
    return items(clips, recipe, create(FASTEST), True, 0, Path())  # sequences need no cache


def loading_rate(clips: list[Clip], recipe: Recipe, workers: int) -> float:
    """Augmented sequences a second as the training loop gets them, start of the workers included."""
    sequences = sequences_of(clips, recipe)
    steps = -(-SEQUENCES // recipe.batch)
    batches = micro_batches(0, steps, recipe.batch, recipe.batch)
    epochs = count()

    def epoch() -> None:
        sequences.set_epoch(next(epochs))
        for _ in loader(sequences, batches, workers):
            pass

    return steps * recipe.batch / median_seconds(epoch)


def training_rate(data: Path, profile: str) -> tuple[str, float]:
    """What was trained, and how many sequences a second, with loading left out."""
    with TemporaryDirectory() as folder:
        training = Training(task_for(FASTEST, data, Path(folder), profile))
        batch = training.recipe.batch
        batches = cycle(list(loader(training.items, micro_batches(0, 2, batch, batch))))
        seconds = median_seconds(lambda: training.step([next(batches)]))
    return f"{FASTEST}, {training.precision}, {training.fabric.device.type}", training.recipe.batch / seconds


def memory_of(clips: list[Clip], recipe: Recipe, folder: Path, size: float) -> dict[str, Any]:
    """Anonymous memory of a process, before and after an epoch over copies of the clips that make up `size` bytes."""
    with TemporaryDirectory(dir=folder) as temporary:
        copies = list(copy_clips(clips, Path(temporary), size))
        total = sum(size_of(copy) for copy in copies)
        with multiprocessing.get_context("spawn").Pool(1) as process:
            before, after = process.apply(anonymous_memory, (copies, recipe))
    return {"data set GB": total / 1e9, "clips": len(copies), "RssAnon MB before": before, "after an epoch": after}


def copy_clips(clips: list[Clip], folder: Path, size: float) -> Iterator[Path]:
    total = 0
    for index, clip in enumerate(cycle(clips)):
        if total >= size:
            return
        total += size_of(clip.path)
        yield Path(shutil.copytree(clip.path, folder / f"{index:05d}"))


def anonymous_memory(paths: list[Path], recipe: Recipe) -> tuple[float | str, float | str]:
    """Megabytes before and after an epoch. Pages of memory-mapped files are not among them: they can go at any time."""
    sequences = sequences_of([Clip(path) for path in paths], recipe)
    steps = max(1, len(sequences) // recipe.batch)
    batches = iter(loader(sequences, micro_batches(0, steps, recipe.batch, recipe.batch)))
    next(batches)
    before = rss_anon()
    for _ in batches:
        pass
    return before, rss_anon()


def rss_anon() -> float | str:
    status = Path("/proc/self/status")
    match = re.search(r"RssAnon:\s*(\d+) kB", status.read_text()) if status.exists() else None
    return int(match[1]) * 1024 / 1e6 if match else "only on Linux"
