"""`onespp bench denoisers`: milliseconds and memory of a frame, next to OIDN in the same run."""

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
from eval.bench.output import bench_folder
from eval.bench.race import TIMED_FRAMES, Contender, Timing, network_of, race
from eval.bench.sizes import Size, parse_size, size_name, thread_counts
from eval.bench.synthetic_frames import synthetic_frame
from eval.selection import cannot_run, choose
from files import read_json, write_json
from models.filters.oidn import OIDN
from models.names import DenoiserName
from models.registry import DENOISERS, create, parse_name, prototype
from models.spec import DenoiserSpec, precisions_of
from models.wrappers.wrapper import unwrapped
from process import keep_freed_memory
from provenance import DENOISING, code_digest, device_in_words, versions
from timing import thread_count

BASELINE = "oidn"  # of the table
ALSO_IN_PYTORCH = ("accumulated", "eaw", "svgf")  # filters that are measured without compiled kernels, too
COUNTING_SIZE = 128  # px; a side that no network needs to pad


@dataclass(frozen=True)
class DenoiserCost(Timing):
    """A row of results.json: times, memory in MB, and what the network is made of; None where there is no such thing.

    Attributes:
        peak_mb: what two frames add to memory: the state and everything in between.
        parameters: of the form that runs.
        prediction: the network's share of the time, between 0 and 1.
    """

    peak_mb: float | None
    parameters: int | None
    macs_per_pixel: float | None
    prediction: float | None

    @property
    def conditions(self) -> tuple[int, int, int]:
        """Height, width and threads, which the rows of one race have in common."""
        return self.height, self.width, self.threads


def ways(names: Sequence[str], device: str = "cpu") -> list[DenoiserSpec]:
    """All ways to run the named denoisers and OIDN, or all that can run here.

    Raises BadInput where a named one is unknown or cannot run.
    """
    baseline = [] if cannot_run(parse_name(BASELINE)) else [BASELINE]
    found: list[DenoiserSpec] = []
    named = [str(parse_name(name).with_budget(None)) for name in names]  # weights make no difference
    for name in choose([*named, *baseline] if names else [], map(DenoiserName, DENOISERS), cannot_run):
        found += [DenoiserSpec(name, precision=precision, device=device) for precision in precisions_of(name)]
        if str(name) in ALSO_IN_PYTORCH and device == "cpu":  # elsewhere PyTorch is the only way
            found.append(DenoiserSpec(name, compiled=False))
        if prototype(name).is_baseline and not name.wrappers:
            found.append(DenoiserSpec(name, signal="indirect", device=device))
    return found


@torch.inference_mode()
def macs_per_pixel(spec: DenoiserSpec) -> float | None:
    """Multiply-accumulates a pixel of the network's convolutions, in the form for inference; None without a network."""
    denoiser = replace(spec, precision="float32", device="cpu").build()
    network = network_of(denoiser)
    if network is None:
        return None
    macs = 0

    def count(layer: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        nonlocal macs
        assert isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)
        gathers = isinstance(layer, nn.Conv2d)  # a transposed one scatters: its inputs meet the weights
        macs += (output if gathers else inputs[0]).numel() * layer.weight[0].numel()

    for layer in network.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            layer.register_forward_hook(count)
    denoiser(synthetic_frame(0, COUNTING_SIZE, COUNTING_SIZE), None)
    return macs / COUNTING_SIZE**2


@torch.inference_mode()
def denoiser_peak_mb(spec: DenoiserSpec, frames: Sequence[Frame], threads: int) -> float | None:
    """What two frames of a sequence add to resident memory, or to the GPU's, in MB, in a fresh process.

    That is the state and everything in between, without the frame itself, the weights and the code.
    """
    keep_freed_memory()  # as commands do
    torch.set_num_threads(threads)
    contender = Contender.of(spec)
    contender.step(synthetic_frame(0, COUNTING_SIZE, COUNTING_SIZE).to(spec.device))  # loads and compiles
    contender.state = None
    # What comes from another process is resident once touched.
    frames = [frame.map(torch.clone).to(spec.device) for frame in frames]

    def play() -> None:
        for frame in frames:
            contender.step(frame)

    if spec.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        play()
        return (torch.cuda.max_memory_allocated() - before) / 1e6
    return growth_mb(play)


def peaks(specs: Sequence[DenoiserSpec], size: Size, threads: int) -> list[float | None]:
    """What each spec adds to memory, in MB, each in a process of its own; None where the system does not tell."""
    frames = [synthetic_frame(index, *size) for index in range(2)]
    return [alone(denoiser_peak_mb, spec, frames, threads) for spec in tqdm(specs, "memory", leave=False)]


def cost(contender: Contender, size: Size, peak_mb: float | None) -> DenoiserCost:
    """What a race has shown of a contender, with the peak memory that was measured apart."""
    spec = contender.spec
    return DenoiserCost(
        **asdict(contender.timing(size)),
        peak_mb=peak_mb,
        parameters=None if isinstance(unwrapped(contender.denoiser), OIDN) else contender.denoiser.parameter_count(),
        macs_per_pixel=macs_per_pixel(spec),
        prediction=contender.share_of_network(),
    )


def devices() -> list[str]:
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def results_file(runs: Path, device: str = "cpu") -> Path:
    """Where the times on a device ("cpu" or "cuda") are kept."""
    return runs / "bench" / ("results.json" if device == "cpu" else f"results-{device}.json")


def bench_denoisers(
    runs: Path,
    names: Sequence[str] = (),
    sizes: Sequence[str] = ("1280x720",),
    threads: Sequence[int] = (),
    measured: int = TIMED_FRAMES,
) -> str:
    """Measure the named denoisers, or all that can run here: a table, and RUNS/bench/results.json.

    On the CPU with each number of `threads`; then, where there is one, on the GPU, into RUNS/bench/results-cuda.json.
    Goes on where the same call was interrupted. Raises BadInput for unknown names, sizes and numbers of threads.
    """
    pixels = [parse_size(size) for size in dict.fromkeys(sizes)]
    counts = thread_counts(threads)
    specs = {device: ways(names, device) for device in devices()}
    tables = []
    for device, ours in specs.items():
        path = results_file(runs, device)
        unfinished = bench_folder(runs) / f"unfinished-{path.name}"
        races = measure_races(ours, pixels, counts if device == "cpu" else counts[-1:], unfinished, measured)
        rows = [*chain.from_iterable(races)]
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


def measure_races(
    specs: Sequence[DenoiserSpec],
    sizes: Sequence[Size],
    counts: Sequence[int],
    unfinished: Path,
    measured: int = TIMED_FRAMES,
) -> Iterator[list[DenoiserCost]]:
    """Yields the rows of each race: size by size, and in each by rising numbers of threads.

    Each is kept in the file `unfinished`, and not run again where that is of the same denoisers, code and device.
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
                    contenders = race(specs, size, measured)
                    rows += [cost(contender, size, peak) for contender, peak in zip(contenders, memory, strict=True)]
                write_json(unfinished, {"call": call, "rows": [asdict(row) for row in rows]})
            yield [row for row in rows if row.conditions == (*size, count)]


def table_lines(rows: Sequence[DenoiserCost]) -> Iterator[dict[str, Any]]:
    """The rows for people: times next to OIDN's, and how they divide between the network and the rest."""
    baselines = {row.conditions: row.ms_median for row in rows if row.denoiser == BASELINE}
    for row in rows:
        baseline = baselines.get(row.conditions)
        share = row.prediction
        yield {
            "denoiser": row.denoiser,
            "size": size_name((row.height, row.width)),
            "dtype": row.dtype,
            "threads": row.threads,
            "ms": row.ms_median,
            "p10": row.ms_p10,
            "p90": row.ms_p90,
            "times oidn": row.ms_median / baseline if baseline else None,
            "prediction": None if share is None else f"{share:.0%}",
            "reconstruction": None if share is None else f"{1 - share:.0%}",
            "peak MB": row.peak_mb,
            "parameters": row.parameters,
            "as trained": None if share is None else create(row.denoiser).parameter_count(),
            "MACs/pixel": row.macs_per_pixel,
        }
