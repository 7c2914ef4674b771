"""`onespp bench denoisers`: milliseconds and memory per frame, next to OIDN in the same run."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import torch
from tabulate import tabulate
from torch import Tensor, nn
from tqdm import tqdm

from datasets.frame import Frame
from eval.bench.memory import alone, growth_mb
from eval.bench.sizes import Size, bench_folder, parse_size, size_name, thread_counts
from eval.bench.synthetic_frames import synthetic_frame
from eval.bench.timed import TIMED_FRAMES, TimedDenoiser, Timing, network_of, time_in_turns
from eval.selection import cannot_run, choose, with_indirect_baselines
from files import read_json, write_json
from models.filters.oidn import OIDN
from models.registry import DENOISERS, DenoiserName, parse_name
from models.spec import DenoiserSpec, fastest_precision, precisions_of
from models.wrappers.wrapper import unwrapped
from process import keep_freed_memory
from provenance import DENOISING, code_digest, device_in_words, versions
from timing import thread_count

BASELINE = "oidn"  # the denoiser that times are divided by
COUNTING_SIZE = 128  # px; a side that no network needs to pad


@dataclass(frozen=True)
class DenoiserCost(Timing):
    """A row of results.json: times, memory in MB, and the size of the network; None where undefined or not measured."""

    peak_mb: float | None  # growth of memory during two frames: the state and all intermediate tensors
    parameters: int | None  # of the network in its form for inference
    macs_per_pixel: float | None

    @property
    def conditions(self) -> tuple[int, int, int]:
        """Height, width and threads."""
        return self.height, self.width, self.threads


def timed_specs(names: Sequence[str], device: str = "cpu", every_way: bool = False) -> list[DenoiserSpec]:
    """The named denoisers and OIDN, or all that can run here, as `onespp eval` runs them.

    With `every_way` also in their other precisions, and in PyTorch where they have compiled kernels. Raises BadInput
    where a named one is unknown or cannot run.
    """
    named = [str(replace(parse_name(name), budget=None)) for name in names]  # weights do not change the time
    if named and not cannot_run(parse_name(BASELINE)):
        named.append(BASELINE)
    chosen = choose(named, map(DenoiserName, DENOISERS), cannot_run)
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


def is_usual(spec: DenoiserSpec) -> bool:
    """Whether `onespp eval` runs the denoiser in this way."""
    return spec.compiled and spec.precision == fastest_precision(spec.denoiser, spec.device)


@torch.inference_mode()
def macs_per_pixel(spec: DenoiserSpec) -> float | None:
    """Multiply-accumulates per pixel in the convolutions of the network as it runs; None without a network."""
    denoiser = replace(spec, precision="float32", device="cpu").build()
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
    timed = TimedDenoiser.of(spec)
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
    """The row of a denoiser that was timed, with its peak memory."""
    return DenoiserCost(
        **asdict(timed.timing(size)),
        peak_mb=peak_mb,
        parameters=None if isinstance(unwrapped(timed.denoiser), OIDN) else timed.denoiser.parameter_count(),
        macs_per_pixel=macs_per_pixel(timed.spec),
    )


def devices() -> list[str]:
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


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
    specs = {device: timed_specs(names, device, every_way) for device in devices()}
    tables = []
    for device, ours in specs.items():
        path = results_file(runs, device)
        unfinished = bench_folder(runs) / f"unfinished-{path.name}"
        timed = measure_rows(ours, pixels, counts if device == "cpu" else counts[-1:], unfinished, measured)
        rows = [*chain.from_iterable(timed)]
        content = {
            "schema": 1,
            "device": device_in_words(device, counts[-1]),
            "threads": counts[-1],  # of the last rows of each size
            "rows": [asdict(row) for row in rows],
        }
        write_json(path, content)
        unfinished.unlink()
        tables.append(f"{device}\n{tabulate(table_lines(rows), 'keys', floatfmt='.3g', missingval='-')}")
    return "\n\n".join(tables)


def measure_rows(
    specs: Sequence[DenoiserSpec],
    sizes: Sequence[Size],
    counts: Sequence[int],
    unfinished: Path,
    measured: int = TIMED_FRAMES,
) -> Iterator[list[DenoiserCost]]:
    """Yield the rows of each size and number of threads.

    They are stored in the file `unfinished` and reused if that is of the same denoisers, code and device.
    """
    modules = {module for spec in specs for module in spec.modules}
    call = {
        "specs": [repr(spec) for spec in specs],
        "frames": measured,
        "code": code_digest(__name__, *sorted(modules)),
        "versions": versions(DENOISING),
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
    """The lines of the table."""
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
