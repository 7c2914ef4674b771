"""How long a training step takes, in both precisions, and where the time goes."""

from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
from tabulate import tabulate
from torch.profiler import ProfilerActivity, profile, record_function
from tqdm import tqdm

from files import write_json
from train.data import in_parts, loader, micro_batches
from train.precision import BFLOAT16, FLOAT32
from train.recipes import DEFAULT
from train.registry import task_for
from train.training import Training

PRECISIONS = (FLOAT32, BFLOAT16)
REPEATS = 5  # steps of each, in turns, besides a first one that warms up; the median counts
CONVOLUTIONS, NETWORK, LOSS, OPTIMISER, LOADING, REST = (
    "convolutions",
    "rest of the network",
    "loss",
    "Adam",
    "loading",
    "other",
)
BACKWARD = "autograd::engine::evaluate_function"


def bench_training(data: Path, runs: Path, profile_name: str, names: Sequence[str]) -> str:
    """Measure steps of the named networks; returns tables and writes RUNS/bench/training.json.

    Raises BadInput for unusable data or an unknown name or profile.
    """
    speeds, shares = [], []
    for name in tqdm(names or DEFAULT, "training", leave=False):
        with TemporaryDirectory() as folder:
            trainings = {p: Training(task_for(name, data, Path(folder), profile_name, precision=p)) for p in PRECISIONS}
            times = step_times(trainings)
            fastest = min(times, key=lambda precision: times[precision])
            row = {f"{precision} ms": ms for precision, ms in times.items()}
            speeds.append({"network": name, **row, "times faster": times["float32"] / times["bfloat16"]})
            shares.append({"network": name, "precision": fastest, **step_shares(trainings[fastest])})
    (runs / "bench").mkdir(parents=True, exist_ok=True)
    device = f"{'cuda' if torch.cuda.is_available() else 'cpu'}, {torch.get_num_threads()} threads"
    content = {"schema": 1, "profile": profile_name, "device": device, "steps": speeds, "shares": shares}
    write_json(runs / "bench" / "training.json", content)
    percent = [
        {key: f"{value:.1%}" if isinstance(value, float) else value for key, value in row.items()} for row in shares
    ]
    return "\n\n".join([tabulate(speeds, "keys", floatfmt=(".0f", ".0f", ".0f", ".2f")), tabulate(percent, "keys")])


def step_times(trainings: dict[str, Training]) -> dict[str, float]:
    """Median milliseconds of a whole step, loading included, of trainings that take turns."""
    times: dict[str, list[float]] = {name: [] for name in trainings}
    for repeat in range(1 + REPEATS):
        for name, training in trainings.items():
            ms = one_step(training, repeat)["step_ms"]
            times[name] += [ms] if repeat else []
    return {name: median(values) for name, values in times.items()}


def one_step(training: Training, number: int) -> dict[str, float]:
    batches = micro_batches(number, number + 1, training.recipe.batch, training.micro_batch)
    return training.step(next(in_parts(loader(training.items, batches), training.parts)))


def named(what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, seen under a name by the profiler."""

    def recorded(*args: Any) -> Any:
        with record_function(what):
            return function(*args)

    return recorded


def step_shares(training: Training) -> dict[str, float]:
    """Shares of the time of a step on the CPU: convolutions forward and back, the rest of the network, the loss, ..."""
    loss = training.loss.module
    with ExitStack() as stack:
        for method in ("predict", "filter"):
            if hasattr(loss.denoiser, method):
                stack.enter_context(patch.object(loss.denoiser, method, named(NETWORK, getattr(loss.denoiser, method))))
        stack.enter_context(patch.object(loss, "forward", named(LOSS, loss.forward)))
        with profile(activities=[ProfilerActivity.CPU]) as profiler:
            measured = one_step(training, 0)
    totals = attribute(list(profiler.events() or []))
    loading = measured["loading_ms"] / measured["step_ms"]
    whole = sum(totals.values())
    shares = {what: (1 - loading) * totals[what] / whole for what in (CONVOLUTIONS, NETWORK, LOSS, OPTIMISER, REST)}
    return {**shares, LOADING: loading}


def attribute(events: list[Any]) -> dict[str, float]:
    """Microseconds by part of the step. What runs on the way back belongs where its forward operation did."""
    forward: dict[int, str] = {}
    for event in events:
        if event.sequence_nr >= 0 and (part := region(event, {})) in (NETWORK, LOSS):
            forward.setdefault(event.sequence_nr, part)
    totals: dict[str, float] = defaultdict(float)
    for event in events:
        part = region(event, forward)
        if part == NETWORK and "conv" in event.name:
            part = CONVOLUTIONS
        totals[part] += event.self_cpu_time_total
    return totals


def region(event: Any, forward: dict[int, str]) -> str:
    """The part of the step that an event lies in, by what called it."""
    while event is not None:
        if event.name in (NETWORK, LOSS):
            return str(event.name)
        if event.name.startswith(BACKWARD):
            return forward.get(event.sequence_nr, REST)
        if event.name.startswith("Optimizer."):
            return OPTIMISER
        event = event.cpu_parent
    return REST
