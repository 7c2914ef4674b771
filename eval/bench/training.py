"""`onespp bench training`: milliseconds of a training step in both precisions, and the share of each part."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import torch
from tabulate import tabulate
from torch.profiler import ProfilerActivity, profile, record_function
from tqdm import tqdm

from eval.bench.sizes import bench_folder
from files import write_json
from timing import device_clock, take_turns
from train.data import in_parts, loader, micro_batches
from train.precision import BFLOAT16, FLOAT32
from train.recipes import ONE_A_PAPER
from train.registry import task_for
from train.training import Training

TIMED_STEPS = 5  # in each precision, after one warm-up step

# The parts of a step.
CONVOLUTIONS = "convolutions"
NETWORK = "rest of the network"
LOSS = "loss"
OPTIMISER = "Adam"
REST = "other"
LOADING = "loading"
BACKWARD = "autograd::engine::evaluate_function"


@dataclass(frozen=True)
class StepTimes:
    """Milliseconds of a network's training step in both precisions."""

    network: str
    full_ms: float
    mixed_ms: float

    @property
    def fastest(self) -> str:
        return FLOAT32 if self.full_ms <= self.mixed_ms else BFLOAT16

    def line(self) -> dict[str, Any]:
        """The row of the table and of training.json."""
        return {
            "network": self.network,
            f"{FLOAT32} ms": self.full_ms,
            f"{BFLOAT16} ms": self.mixed_ms,
            "times faster": self.full_ms / self.mixed_ms,
        }


@dataclass(frozen=True)
class StepShares:
    """The share of each part in the time of a step, between 0 and 1, in the faster precision."""

    network: str
    precision: str
    shares: Mapping[str, float]

    def line(self) -> dict[str, Any]:
        """The row of training.json."""
        return {"network": self.network, "precision": self.precision, **self.shares}

    def percent(self) -> dict[str, str]:
        """The row of the table."""
        shares = {part: f"{share:.1%}" for part, share in self.shares.items()}
        return {"network": self.network, "precision": self.precision, **shares}


def bench_training(data: Path, runs: Path, budget: str, names: Sequence[str] = (), measured: int = TIMED_STEPS) -> str:
    """Measure steps of the named networks, by default one per paper: tables, and RUNS/bench/training.json.

    Raises BadInput for unusable data or an unknown name or budget.
    """
    times: list[StepTimes] = []
    shares: list[StepShares] = []
    for name in tqdm(names or ONE_A_PAPER, "training", leave=False):
        with TemporaryDirectory() as folder:
            trainings = {
                precision: Training(replace(task_for(name, data, Path(folder), budget), precision=precision))
                for precision in (FLOAT32, BFLOAT16)
            }
            ms = step_ms(trainings, measured)
            times.append(StepTimes(name, ms[FLOAT32], ms[BFLOAT16]))
            fastest = times[-1].fastest
            shares.append(StepShares(name, fastest, step_shares(trainings[fastest])))
    content = {
        "schema": 1,
        "profile": budget,
        "device": f"{training_device()}, {torch.get_num_threads()} threads",
        "steps": [row.line() for row in times],
        "shares": [row.line() for row in shares],
    }
    write_json(bench_folder(runs) / "training.json", content)
    time_table = tabulate(content["steps"], "keys", floatfmt=(".0f", ".0f", ".0f", ".2f"))
    return f"{time_table}\n\n{tabulate([row.percent() for row in shares], 'keys')}"


def training_device() -> str:
    """The device that trains: "cpu" or "cuda"."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def step_ms(trainings: Mapping[str, Training], measured: int) -> dict[str, float]:
    """Median milliseconds of a whole step, including loading, of several trainings in turn."""

    def stepping(training: Training) -> Callable[[], object]:
        numbers = count()
        return lambda: one_step(training, next(numbers))

    work = {name: stepping(training) for name, training in trainings.items()}
    seconds = take_turns(work, measured, clock=partial(device_clock, training_device()))
    return {name: 1e3 * median(spent) for name, spent in seconds.items()}


def one_step(training: Training, number: int) -> dict[str, float]:
    """Train on the items of step `number`. Returns the training's record of the step."""
    batches = micro_batches(number, number + 1, training.recipe.batch, training.micro_batch)
    return training.step(next(in_parts(loader(training.items, batches), training.parts)))


def named(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, recorded by the profiler under `name`."""

    def recorded(*args: Any) -> Any:
        with record_function(name):
            return function(*args)

    return recorded


def step_shares(training: Training) -> dict[str, float]:
    """The share of each part in the time of a step on the CPU, forward and backward."""
    loss = training.loss.module
    with ExitStack() as stack:
        for method in ("predict", "filter"):
            if hasattr(loss.denoiser, method):
                stack.enter_context(patch.object(loss.denoiser, method, named(NETWORK, getattr(loss.denoiser, method))))
        stack.enter_context(patch.object(loss, "forward", named(LOSS, loss.forward)))
        with profile(activities=[ProfilerActivity.CPU]) as profiler:
            noted = one_step(training, 0)
    totals = attribute(list(profiler.events() or []))
    loading = noted["loading_ms"] / noted["step_ms"]
    whole = sum(totals.values())
    parts = (CONVOLUTIONS, NETWORK, LOSS, OPTIMISER, REST)
    return {part: (1 - loading) * totals[part] / whole for part in parts} | {LOADING: loading}


def attribute(events: list[Any]) -> dict[str, float]:
    """Microseconds by part of the step. A backward operation is attributed to the part of its forward operation."""
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
    """The part of the step to which an event belongs, according to its callers."""
    while event is not None:
        if event.name in (NETWORK, LOSS):
            return str(event.name)
        if event.name.startswith(BACKWARD):
            return forward.get(event.sequence_nr, REST)
        if event.name.startswith("Optimizer."):
            return OPTIMISER
        event = event.cpu_parent
    return REST
