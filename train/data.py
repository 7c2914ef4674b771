"""Batches of sequences or of accumulated crops, and which process reads which."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import torch

from datasets.clip import Clip
from models.denoiser import Denoiser
from train.augmentation import Augmentation
from train.crops import AccumulatedCrops, AnyBatch
from train.protocols import FilteringNetwork
from train.sequences import TrainingSequences
from train.task import Recipe

Items = TrainingSequences | AccumulatedCrops

PIXELS_IN_MEMORY = 2**20  # of all frames of a micro-batch, by default


def items(clips: list[Clip], recipe: Recipe, denoiser: Denoiser, training: bool, seed: int, cache: Path) -> Items:
    """The items of `clips`; accumulated frames are kept in `cache`. Raises BadInput as `check_fits`."""
    if recipe.crops:
        assert isinstance(denoiser, FilteringNetwork)
        return AccumulatedCrops(clips, denoiser, recipe.crops[0 if training else 1], recipe.crop, seed, cache)
    augmentation = recipe.augmentation if training else Augmentation()
    frames = recipe.frames(training)
    return TrainingSequences(
        clips, denoiser.reads, frames, recipe.crop, augmentation, seed, denoiser.signal, recipe.firsts
    )


def largest_micro_batch(recipe: Recipe, clip: Clip) -> int:
    """How many items of a batch are in memory together by default."""
    area = recipe.crop**2 if recipe.crop else clip.height * clip.width
    return max(1, min(recipe.batch, PIXELS_IN_MEMORY // ((recipe.length + recipe.firsts) * area)))


def equal_parts(count: int, largest: int) -> list[range]:
    """The fewest parts of range(count) of at most `largest`; equal, for the mean of their means to be that of all."""
    parts = next(n for n in range(1, count + 1) if count % n == 0 and count // n <= largest)
    return [range(i, i + count // parts) for i in range(0, count, count // parts)]


def micro_batches(first: int, stop: int, batch: int, largest: int, rank: int = 0, world: int = 1) -> list[list[int]]:
    """Item numbers of the steps `first` to `stop`: `batch` a step, of which process `rank` of `world` takes its share.

    A share comes in parts of at most `largest` items, the same number of parts every step.
    """
    share = batch // world
    starts = [step * batch + rank * share for step in range(first, stop)]
    return [[start + i for i in part] for start in starts for part in equal_parts(share, largest)]


def load_ahead(items: Items, batches: Iterable[list[int]]) -> Iterator[AnyBatch]:
    """The batches of these item numbers, each loaded by a thread while the one before it is worked on."""
    # PyTorch gives the number of threads that the loading thread sets to all threads that have not read theirs yet:
    # read it now, or a training that has done no large operation so far continues with one.
    torch.get_num_threads()
    loaded: Iterator[AnyBatch] = map(items.batch, batches)
    with ThreadPoolExecutor(1, initializer=torch.set_num_threads, initargs=(1,)) as thread:
        loading = thread.submit(next, loaded, None)
        while (batch := loading.result()) is not None:
            loading = thread.submit(next, loaded, None)
            yield batch
