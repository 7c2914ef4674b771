"""`onespp bench fusion`: weight-shared kernel fusion next to the way the paper writes it, unfold and softmax."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
from tabulate import tabulate
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from eval.bench.memory import alone, growth_mb
from eval.bench.output import bench_folder
from eval.bench.sizes import Size, parse_size, threads_or_all
from files import write_json
from models import compiled
from models.fusion import fuse
from models.parameters import WINDOWS
from timing import take_turns, thread_count

UNFOLD = "unfold and softmax"
FUSE_IN_PYTORCH = "onespp, PyTorch"
FUSE_COMPILED = "onespp, compiled"
METHODS = (UNFOLD, FUSE_IN_PYTORCH, FUSE_COMPILED)
UNFOLD_ROUNDS = 3  # that count; each takes seconds
FUSE_ROUNDS = 15

Inputs = tuple[Tensor, Tensor, Tensor]  # image, importance and mixture of models.fusion.fuse


@dataclass(frozen=True)
class FusionCost:
    """What a method takes, next to unfolding; memory is None where the system does not tell."""

    method: str
    ms: float
    times_faster: float
    peak_mb: float | None
    share_of_memory: float | None
    largest_difference: float  # relative

    def line(self) -> dict[str, Any]:
        """As it stands in the table and in fusion.json."""
        return {
            "method": self.method,
            "ms": self.ms,
            "times faster": self.times_faster,
            "peak MB": self.peak_mb,
            "share of memory": self.share_of_memory,
            "largest relative difference": self.largest_difference,
        }


def unfold_kernel(image: Tensor, logits: Tensor, window: int) -> Tensor:
    """Eq. 3 and 4 of Fan et al. 2021 as they are written: a kernel map by unfolding, softmax, weighted sum.

    `image` (B, C, H, W), `logits` (B, 1, H, W), a `window` of so many pixels a side; returns (B, C, H, W).
    """
    batch, channels, height, width = image.shape
    margin = window // 2
    entries = F.pad(logits, (margin,) * 4, value=-torch.inf)
    weights = torch.softmax(F.unfold(entries, window), dim=1)  # (B, k k, H W)
    values = F.unfold(F.pad(image, (margin,) * 4), window).view(batch, channels, window**2, -1)
    return (values * weights[:, None]).sum(dim=2).view(batch, channels, height, width)


def unfold_fuse(image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int] = WINDOWS) -> Tensor:
    """Eq. 5: what models.fusion.fuse computes, in the straightforward way; any dtype."""
    shares = torch.softmax(mixture, dim=1)
    parts = [shares[:, [i]] * unfold_kernel(image, importance[:, [i]], k) for i, k in enumerate(windows)]
    return torch.stack(parts).sum(dim=0)


def run_method(method: str, inputs: Inputs) -> Tensor:
    if method == UNFOLD:
        return unfold_fuse(*inputs)
    with compiled.disabled() if method == FUSE_IN_PYTORCH else nullcontext():
        return fuse(*inputs)


def random_inputs(size: Size) -> Inputs:
    """An image with a few bright pixels, and logits for all windows; always the same."""
    height, width = size
    torch.manual_seed(0)
    importance, mixture = 2 * torch.randn(2, 1, len(WINDOWS), height, width)
    return torch.rand(1, 3, height, width) ** 4 * 10, importance, mixture


@torch.inference_mode()
def method_peak_mb(method: str, size: Size, threads: int) -> float | None:
    """How far resident memory rises in one call, in MB; in a process of its own."""
    torch.set_num_threads(threads)
    inputs = random_inputs(size)
    run_method(method, random_inputs((32, 32)))  # loads and compiles
    return growth_mb(lambda: run_method(method, inputs))


def time_methods(size: Size, rounds: int, unfold_rounds: int) -> tuple[dict[str, float], dict[str, Tensor]]:
    """Median seconds of each method, and what it returns."""
    inputs = random_inputs(size)
    outputs: dict[str, Tensor] = {}

    def running(method: str) -> Callable[[], None]:
        return lambda: outputs.update({method: run_method(method, inputs)})

    work = {method: running(method) for method in METHODS}
    seconds = take_turns(work, unfold_rounds, label="fusion")
    del work[UNFOLD]  # the others go on without it
    for method, more in take_turns(work, rounds - unfold_rounds, warm_up=0, label="fusion").items():
        seconds[method] += more
    return {method: median(spent) for method, spent in seconds.items()}, outputs


@torch.inference_mode()
def bench_fusion(
    runs: Path,
    size: str = "1280x720",
    threads: int | None = None,
    rounds: int = FUSE_ROUNDS,
    unfold_rounds: int = UNFOLD_ROUNDS,
) -> str:
    """Milliseconds, peak memory and error of each method, in turns: a table, and RUNS/bench/fusion.json.

    With `threads`, by default as many as PyTorch takes. Raises BadInput for what is no size or number of threads.
    """
    pixels = parse_size(size)
    count = threads_or_all(threads)
    with thread_count(count):
        seconds, outputs = time_methods(pixels, rounds, unfold_rounds)
    peaks = {method: alone(method_peak_mb, method, pixels, count) for method in tqdm(METHODS, "memory", leave=False)}
    baseline_mb = peaks[UNFOLD]
    rows = [
        FusionCost(
            method=method,
            ms=1e3 * seconds[method],
            times_faster=seconds[UNFOLD] / seconds[method],
            peak_mb=peak_mb,
            share_of_memory=peak_mb / baseline_mb if peak_mb is not None and baseline_mb else None,
            largest_difference=float((outputs[method] / outputs[UNFOLD] - 1).abs().max()),
        ).line()
        for method, peak_mb in peaks.items()
    ]
    height, width = pixels
    content = {
        "device": "cpu",
        "threads": count,
        "height": height,
        "width": width,
        "windows": WINDOWS,
        "rows": rows,
    }
    write_json(bench_folder(runs) / "fusion.json", content)
    return tabulate(rows, "keys", floatfmt=".3g", missingval="-")
