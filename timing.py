"""One way to measure time: whatever is compared takes turns, so that drift of the machine hits all alike."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import inf

import torch
from tqdm import tqdm

PIXELS_A_THREAD = 256 * 256  # with fewer, threads mostly wait for each other

Clock = Callable[[], float]  # seconds


def device_clock(device: str) -> float:
    """Seconds, once the device ("cpu" or "cuda") has done all that it was given."""
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
        before_round: is told the number of each round, from 0, before it begins; its time does not count.
        fewest: rounds that count, at least, where all together take longer than `patience` seconds.
        clock: waits for the device, where the work is done on one.
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
    """PyTorch takes `threads` threads within the context."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def threads_for(height: int, width: int) -> int:
    """How many of PyTorch's threads are worth sharing an image among."""
    return max(1, min(torch.get_num_threads(), height * width // PIXELS_A_THREAD))
