"""Timing: functions that are compared take turns, so that drift of the machine affects all of them equally."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import inf

import torch
from tqdm import tqdm

PIXELS_PER_THREAD = 256 * 256  # with fewer, threads mostly wait for each other

Clock = Callable[[], float]  # seconds


def device_clock(device: str) -> float:
    """Seconds, once the device ("cpu" or "cuda") has finished its work."""
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def take_turns(
    work: Mapping[str, Callable[[], object]],
    measured: int,
    warm_up: int = 1,
    before_round: Callable[[int], None] = lambda index: None,
    fewest: int | None = None,
    patience: float = inf,
    clock: Clock = time.perf_counter,
    label: str | None = "timing",
) -> dict[str, list[float]]:
    """Seconds of each call of each function, called in turns.

    Args:
        measured: rounds that count, after `warm_up` rounds that do not.
        before_round: called with the number of each round, from 0, before it begins; its time does not count.
        fewest: rounds that count, at least, if all rounds take longer than `patience` seconds.
        clock: of a GPU, one that waits for it.
        label: of the progress bar; None for no bar.
    """
    seconds: dict[str, list[float]] = {name: [] for name in work}
    rounds = warm_up + measured
    end = time.perf_counter() + patience
    with tqdm(total=rounds * len(work), desc=label, leave=False, disable=label is None) as progress:
        for index in range(rounds):
            before_round(index)
            for name, function in work.items():
                progress.set_postfix_str(name)
                start = clock()
                function()
                seconds[name].append(clock() - start)
                progress.update()
            if fewest is not None and index + 1 >= warm_up + fewest and time.perf_counter() > end:
                break
    return {name: values[warm_up:] for name, values in seconds.items()}


@contextmanager
def thread_count(threads: int) -> Iterator[None]:
    """A context in which PyTorch uses `threads` threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def threads_for(height: int, width: int) -> int:
    """How many of PyTorch's threads to share an image of this size among."""
    return max(1, min(torch.get_num_threads(), height * width // PIXELS_PER_THREAD))
