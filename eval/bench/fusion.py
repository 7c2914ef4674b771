"""`onespp bench fusion`: weight-shared kernel fusion next to the way the paper writes it, unfold and softmax."""

import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from statistics import median
from typing import Any

import torch
from tabulate import tabulate
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from eval.bench.memory import alone, growth_mb
from files import write_json
from models import compiled
from models.fusion import fuse
from models.parameters import WINDOWS
from timing import thread_count

UNFOLD, PYTORCH, COMPILED = "unfold and softmax", "onespp, PyTorch", "onespp, compiled"
REPEATS = {UNFOLD: 3, PYTORCH: 15, COMPILED: 15}


def unfold_kernel(image: Tensor, logits: Tensor, window: int) -> Tensor:
    """Eq. 3 and 4 of Fan et al. 2021 as they are written: a kernel map by unfolding, softmax, weighted sum."""
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


def method(label: str) -> Callable[..., Tensor]:
    if label == UNFOLD:
        return unfold_fuse

    def run(image: Tensor, importance: Tensor, mixture: Tensor) -> Tensor:
        with compiled.disabled() if label == PYTORCH else nullcontext():
            return fuse(image, importance, mixture)

    return run


def inputs(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    torch.manual_seed(0)
    maps = 2 * torch.randn(2, 1, len(WINDOWS), height, width)
    return torch.rand(1, 3, height, width) ** 4 * 10, maps[0], maps[1]


@torch.inference_mode()
def peak_mb(label: str, height: int, width: int, threads: int) -> float | None:
    """How far resident memory rises in one call, in a process of its own."""
    torch.set_num_threads(threads)
    run, arguments = method(label), inputs(height, width)
    run(*inputs(32, 32))  # loads and compiles
    return growth_mb(lambda: run(*arguments))


@torch.inference_mode()
def bench_fusion(runs: Path, height: int, width: int, threads: int | None = None) -> str:
    """Milliseconds, peak memory and error of each way, in turns: a table, and RUNS/bench/fusion.json."""
    threads = threads or torch.get_num_threads()
    labels = list(REPEATS)
    arguments = inputs(height, width)
    seconds: dict[str, list[float]] = {label: [] for label in labels}
    outputs: dict[str, Tensor] = {}
    with thread_count(threads):
        for repeat in tqdm(range(-1, max(REPEATS.values())), "fusion", leave=False):
            for label in labels:
                if repeat < REPEATS[label]:
                    start = time.perf_counter()
                    outputs[label] = method(label)(*arguments)
                    seconds[label] += [time.perf_counter() - start] if repeat >= 0 else []
    peaks = {label: alone(peak_mb, label, height, width, threads) for label in tqdm(labels, "memory", leave=False)}
    rows: list[dict[str, Any]] = []
    for label in labels:
        ms, peak, baseline = 1e3 * median(seconds[label]), peaks[label], peaks[UNFOLD]
        rows.append(
            {
                **{"method": label, "ms": ms, "times faster": 1e3 * median(seconds[UNFOLD]) / ms, "peak MB": peak},
                "share of memory": peak / baseline if peak is not None and baseline else None,
                "largest relative difference": float((outputs[label] / outputs[UNFOLD] - 1).abs().max()),
            }
        )
    folder = runs / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    facts = {"device": "cpu", "threads": threads, "height": height, "width": width, "windows": WINDOWS}
    write_json(folder / "fusion.json", {**facts, "rows": rows})
    return tabulate(rows, "keys", floatfmt=".3g", missingval="-")
