"""`onespp bench denoisers`: milliseconds and memory per frame, next to OIDN in the same run."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tabulate import tabulate
from torch import Tensor, nn
from tqdm import tqdm

from datasets.frame import Frame
from errors import BadInput
from eval.bench.memory import alone, growth_mb, release_memory
from eval.bench.synthetic_frames import synthetic_frame
from eval.selection import cannot_run, choose, with_indirect_baselines
from files import read_json, write_json
from models.denoiser import Denoiser, State
from models.filters.oidn import OIDN
from models.registry import DENOISERS, DenoiserName, parse_name, prototype
from models.spec import DenoiserSpec, fastest_precision, precisions_of
from models.wrappers.wrapper import unwrapped
from process import keep_freed_memory
from provenance import DENOISING, MadeBy, code_digest, device_in_words, versions
from timing import device_clock, take_turns, thread_count

BASELINE = "oidn"  # the denoiser that times are divided by
COUNTING_SIZE = 128  # px; a side that no network needs to pad
WARM_UP_FRAMES = 2
TIMED_FRAMES = 10
FEWEST_FRAMES = 5  # timed, where all denoisers together take longer than
MAX_SECONDS = 240.0

Size = tuple[int, int]  # height, width


def parse_size(text: str) -> Size:
    """(height, width) in pixels of "1280x720". Raises BadInput for other text."""
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not match:
        raise BadInput(f"'{text}' is not a size such as 1280x720")
    return int(match[2]), int(match[1])


def size_name(size: Size) -> str:
    """The inverse of parse_size: "1280x720" of (720, 1280)."""
    return f"{size[1]}x{size[0]}"


def thread_counts(threads: Sequence[int]) -> list[int]:
    """The numbers of threads to measure with, rising; by default all of PyTorch's. Raises BadInput below 1."""
    for count in threads:
        if count < 1:
            raise BadInput(f"{count} threads cannot work: name at least 1")
    return sorted({*threads} or {torch.get_num_threads()})


@dataclass(frozen=True)
class DenoiserCost:
    """A row of results.json. Memory and the size of the network are None where undefined or not measured."""

    denoiser: str
    height: int
    width: int
    dtype: str
    threads: int
    frames: int  # that were timed
    ms_median: float  # milliseconds per frame, and their 10th and 90th percentile
    ms_p10: float
    ms_p90: float
    peak_mb: float | None  # growth of memory during two frames: the state and all intermediate tensors
    parameters: int | None  # of the network in its form for inference
    macs_per_pixel: float | None

    @property
    def conditions(self) -> tuple[int, int, int]:
        return self.height, self.width, self.threads


def computes_on(device: str, name: DenoiserName) -> bool:
    """Whether a denoiser computes on a device; OIDN does on the CPU alone, to which it copies images of a GPU."""
    return device == "cpu" or not isinstance(unwrapped(prototype(name)), OIDN)


def timed_specs(names: Sequence[str], device: str = "cpu", every_way: bool = False) -> list[DenoiserSpec]:
    """The named denoisers and OIDN, or all that can run here, as `onespp eval` runs them; on a GPU without OIDN.

    With `every_way` also in their other precisions, and in PyTorch where they have compiled kernels. Raises BadInput
    where a named one is unknown or cannot run.
    """
    named = [str(replace(parse_name(name), budget=None)) for name in names]  # weights do not change the time
    if named and not cannot_run(parse_name(BASELINE)):
        named.append(BASELINE)
    chosen = [name for name in choose(named, map(DenoiserName, DENOISERS), cannot_run) if computes_on(device, name)]
    specs = [DenoiserSpec(name, precision=fastest_precision(name, device), device=device) for name in chosen]
    others = [other for spec in specs for other in other_ways(spec)] if every_way else []
    return [*with_indirect_baselines(specs), *others]


def other_ways(spec: DenoiserSpec) -> list[DenoiserSpec]:
    """The same denoiser in other precisions, and in PyTorch where it has compiled kernels."""
    precisions = precisions_of(spec.denoiser)
    ways = [replace(spec, precision=precision) for precision in precisions if precision != spec.precision]
    if spec.facts.has_kernels and spec.device == "cpu":
        ways.append(replace(spec, precision="float32", compiled=False))
    return ways


class TimedDenoiser:
    """A denoiser, its state, and the seconds of each frame after warm-up."""

    def __init__(self, spec: DenoiserSpec):
        self.spec = spec
        self.denoiser = spec.build()
        self.state: State | None = None
        self.seconds: list[float] = []

    def step(self, frame: Frame) -> None:
        """Denoise the next frame, which is on the device already."""
        with self.spec.running():
            _, self.state = self.denoiser(frame, self.state)


@torch.inference_mode()
def time_in_turns(
    specs: Sequence[DenoiserSpec], size: Size, measured: int = TIMED_FRAMES, max_seconds: float = MAX_SECONDS
) -> list[TimedDenoiser]:
    """Time all specs, of one device, on one sequence: each frame by each of them in turn.

    After `max_seconds` it stops before `measured` frames, but not before FEWEST_FRAMES.
    """
    release_memory()  # of earlier calls: the states of all denoisers at 1920 x 1080 fill most of 24 GB
    denoisers = [TimedDenoiser(spec) for spec in specs]
    device = specs[0].device
    frame: Frame

    def make_frame(index: int) -> None:
        nonlocal frame
        frame = synthetic_frame(index, *size).to(device)

    def stepping(timed: TimedDenoiser) -> Callable[[], None]:
        return lambda: timed.step(frame)

    seconds = take_turns(
        {f"{timed.spec.way} {timed.spec.precision}": stepping(timed) for timed in denoisers},
        measured,
        warm_up=WARM_UP_FRAMES,
        before_round=make_frame,
        fewest=FEWEST_FRAMES,
        patience=max_seconds,
        clock=partial(device_clock, device),
        label=size_name(size),
    )
    for timed, spent in zip(denoisers, seconds.values(), strict=True):
        timed.seconds = spent
    return denoisers


def is_usual(spec: DenoiserSpec) -> bool:
    """Whether `onespp eval` runs the denoiser in this way."""
    return spec.compiled and spec.precision == fastest_precision(spec.denoiser, spec.device)


def network_of(denoiser: Denoiser) -> nn.Module | None:
    network = getattr(unwrapped(denoiser), "network", None)
    return network if isinstance(network, nn.Module) else None


@torch.inference_mode()
def macs_per_pixel(spec: DenoiserSpec) -> float | None:
    """Multiply-accumulates per pixel in the convolutions of the network as it runs; None without a network."""
    # In PyTorch, whose layers can be watched.
    denoiser = replace(spec, precision="float32", device="cpu", compiled=False).build()
    network = network_of(denoiser)
    if network is None:
        return None
    macs = 0

    def count(layer: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        nonlocal macs
        assert isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)
        gathers = isinstance(layer, nn.Conv2d)  # a transposed one scatters: its inputs are multiplied
        macs += (output if gathers else inputs[0]).numel() * layer.weight[0].numel()

    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            layer.register_forward_hook(count)
    denoiser(synthetic_frame(0, COUNTING_SIZE, COUNTING_SIZE), None)
    return macs / COUNTING_SIZE**2


@torch.inference_mode()
def denoiser_peak_mb(spec: DenoiserSpec, frames: Sequence[Frame], threads: int) -> float | None:
    """Growth of resident memory, or of the GPU's, during two frames, in MB; call it in a fresh process.

    It counts the state and all intermediate tensors, but not frames, weights and code.
    """
    keep_freed_memory()  # as commands do
    torch.set_num_threads(threads)
    timed = TimedDenoiser(spec)
    timed.step(synthetic_frame(0, COUNTING_SIZE, COUNTING_SIZE).to(spec.device))  # loads and compiles
    timed.state = None
    # Tensors from another process become resident when first read.
    frames = [frame.map(torch.clone).to(spec.device) for frame in frames]

    def play() -> None:
        for frame in frames:
            timed.step(frame)

    if spec.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        play()
        return (torch.cuda.max_memory_allocated() - before) / 1e6
    return growth_mb(play)


def peaks(specs: Sequence[DenoiserSpec], size: Size, threads: int) -> list[float | None]:
    """The peak memory of each spec, in MB, measured in separate processes; None where unknown, and for unusual ways."""
    frames = [synthetic_frame(index, *size) for index in range(2)]
    progress = tqdm(specs, "memory", leave=False)
    return [alone(denoiser_peak_mb, spec, frames, threads) if is_usual(spec) else None for spec in progress]


def cost(timed: TimedDenoiser, size: Size, peak_mb: float | None) -> DenoiserCost:
    p10, median, p90 = (float(ms) for ms in 1e3 * np.percentile(timed.seconds, (10, 50, 90)))
    return DenoiserCost(
        timed.spec.way,
        *size,
        dtype=timed.spec.precision,
        threads=torch.get_num_threads(),
        frames=len(timed.seconds),
        ms_median=median,
        ms_p10=p10,
        ms_p90=p90,
        peak_mb=peak_mb,
        parameters=None if isinstance(unwrapped(timed.denoiser), OIDN) else timed.denoiser.parameter_count(),
        macs_per_pixel=macs_per_pixel(timed.spec),
    )


def timed_with() -> MadeBy:
    """The packages and the code that times depend on; this module imports all denoisers."""
    return {"versions": versions(DENOISING), "code": code_digest(__name__)}


def results_file(runs: Path, device: str = "cpu") -> Path:
    """The file of the times on a device, "cpu" or "cuda"."""
    return runs / "bench" / ("results.json" if device == "cpu" else f"results-{device}.json")


def bench_denoisers(
    runs: Path,
    names: Sequence[str] = (),
    sizes: Sequence[str] = ("1280x720",),
    threads: Sequence[int] = (),
    measured: int = TIMED_FRAMES,
    every_way: bool = False,
) -> str:
    """Measure the named denoisers, or all that can run here. Returns a table and writes RUNS/bench/results.json.

    By default each in the precision that `onespp eval` uses, with all threads; with `every_way` in all precisions, with
    one thread and all, and in PyTorch. If there is a GPU, results on it go to RUNS/bench/results-cuda.json. An
    interrupted call is resumed. Raises BadInput for unknown names, sizes and numbers of threads.
    """
    pixels = [parse_size(size) for size in dict.fromkeys(sizes)]
    counts = thread_counts(threads or ((1, torch.get_num_threads()) if every_way else ()))
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    specs = {device: ours for device in devices if (ours := timed_specs(names, device, every_way))}
    tables = []
    for device, ours in specs.items():
        path = results_file(runs, device)
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f"unfinished-{path.name}")
        timed = measure_rows(ours, pixels, counts if device == "cpu" else counts[-1:], unfinished, measured)
        rows = [*chain.from_iterable(timed)]
        content = {
            "schema": 1,
            "device": device_in_words(device, counts[-1]),
            "threads": counts[-1],  # of the last rows of each size
            "made_by": timed_with(),
            "rows": [asdict(row) for row in rows],
        }
        write_json(path, content)
        unfinished.unlink()
        head = device if device == "cpu" else f"{device}, without OIDN, which computes on the CPU"
        tables.append(f"{head}\n{tabulate(table_lines(rows), 'keys', floatfmt='.3g', missingval='-')}")
    return "\n\n".join(tables)


def measure_rows(
    specs: Sequence[DenoiserSpec],
    sizes: Sequence[Size],
    counts: Sequence[int],
    unfinished: Path,
    measured: int = TIMED_FRAMES,
) -> Iterator[list[DenoiserCost]]:
    """Yield the rows of each size and number of threads; those of the same call in `unfinished` are reused."""
    call = {
        "specs": [repr(spec) for spec in specs],
        "frames": measured,
        "made_by": timed_with(),
        "device": device_in_words(specs[0].device),
    }
    before = read_json(unfinished, ("call", "rows")) if unfinished.exists() else {}
    rows = [DenoiserCost(**row) for row in before["rows"]] if before.get("call") == call else []
    done = {row.conditions for row in rows}
    for size in sizes:
        missing = [count for count in counts if (*size, count) not in done]
        memory = peaks(specs, size, counts[-1]) if missing else []
        for count in counts:
            if count in missing:
                with thread_count(count):
                    timed = time_in_turns(specs, size, measured)
                    rows += [cost(denoiser, size, peak) for denoiser, peak in zip(timed, memory, strict=True)]
                write_json(unfinished, {"call": call, "rows": [asdict(row) for row in rows]})
            yield [row for row in rows if row.conditions == (*size, count)]


def table_lines(rows: Sequence[DenoiserCost]) -> Iterator[dict[str, Any]]:
    baselines = {row.conditions: row.ms_median for row in rows if row.denoiser == BASELINE}
    for row in rows:
        baseline = baselines.get(row.conditions)
        yield {
            "denoiser": row.denoiser,
            "size": size_name((row.height, row.width)),
            "dtype": row.dtype,
            "threads": row.threads,
            "ms": row.ms_median,
            "p10": row.ms_p10,
            "p90": row.ms_p90,
            "times oidn": row.ms_median / baseline if baseline else None,
            "peak MB": row.peak_mb,
            "parameters": row.parameters,
            "MACs/pixel": row.macs_per_pixel,
        }
