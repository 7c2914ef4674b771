"""`onespp bench denoisers`: milliseconds and memory of a frame, next to OIDN in the same run."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from tabulate import tabulate
from torch import Tensor, nn
from tqdm import tqdm

from datasets.frame import Frame
from eval.bench.memory import alone, growth_mb
from eval.bench.race import Contender, Timing, network_of, race
from eval.bench.sizes import Size, parse_size, size_name, thread_counts
from eval.bench.synthetic_frames import synthetic_frame
from eval.extra_denoisers import ALL_WINDOWS, EXTRA, FAST_OIDN
from eval.selection import BASELINES, choose, unavailable
from eval.spec import DenoiserSpec, create, precisions_of
from files import read_json, write_json
from models.registry import DENOISERS
from provenance import DENOISING, code_digest, device_in_words, versions
from timing import thread_count

OIDN = "oidn"  # the baseline of the table
ALSO_IN_PYTORCH = ("accumulated", "eaw", "svgf")  # filters that are also measured without compiled kernels
COUNTING_SIZE = 128  # px; a side that no network needs to pad


@dataclass(frozen=True)
class Row(Timing):
    """A row of results.json: times, memory in MB, and what the network is made of."""

    peak_mb: float | None
    parameters: int | None
    macs_per_pixel: float | None
    prediction: float | None  # the network's share of the time

    @property
    def race(self) -> tuple[int, int, int]:
        return self.height, self.width, self.threads


def ways(names: Sequence[str], device: str = "cpu") -> list[DenoiserSpec]:
    """All ways to run the named denoisers and OIDN, or all that can run here, networks of other sizes too.

    Raises BadInput where a named one is unknown or cannot run.
    """
    everyone = (*DENOISERS, *(name for name in EXTRA if name not in (ALL_WINDOWS, FAST_OIDN)))
    baseline = [] if unavailable(OIDN) else [OIDN]
    found = []
    for name in choose([*names, *baseline] if names else [], everyone, unavailable):
        found += [DenoiserSpec(name, precision=precision, device=device) for precision in precisions_of(name)]
        if name in ALSO_IN_PYTORCH and device == "cpu":  # elsewhere PyTorch is the only way
            found.append(DenoiserSpec(name, compiled=False))
        if name in BASELINES:
            found.append(DenoiserSpec(name, signal="indirect", device=device))
        if name == OIDN:
            found.append(DenoiserSpec(FAST_OIDN, device=device))
    return found


@torch.inference_mode()
def macs_per_pixel(spec: DenoiserSpec) -> float | None:
    """Multiply-accumulates of the network's convolutions a pixel, in the form for inference; None without a network."""
    denoiser = replace(spec, precision="float32", device="cpu").build()
    network = network_of(denoiser)
    macs = 0

    def count(layer: nn.Module, inputs: Any, output: Tensor) -> None:
        nonlocal macs
        assert isinstance(layer, nn.Conv2d)
        macs += output.numel() * layer.weight[0].numel()

    if network is None:
        return None
    for layer in network.modules():
        if isinstance(layer, nn.Conv2d):
            layer.register_forward_hook(count)
    denoiser(synthetic_frame(0, COUNTING_SIZE, COUNTING_SIZE), None)
    return macs / COUNTING_SIZE**2


@torch.inference_mode()
def peak_memory(spec: DenoiserSpec, frames: Sequence[Frame], threads: int) -> float | None:
    """What two frames of a sequence add to resident memory, or to the GPU's, in MB, in a fresh process.

    That is the state and everything in between, without the frame itself, the weights and the code.
    """
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
    """The peak memory of each spec, in MB, each in a process of its own."""
    frames = [synthetic_frame(index, *size) for index in range(2)]
    return [alone(peak_memory, spec, frames, threads) for spec in tqdm(specs, "memory", leave=False)]


def row(contender: Contender, size: Size, peak_mb: float | None) -> Row:
    spec = contender.spec
    is_ours = not spec.name.startswith(OIDN)
    return Row(
        **asdict(contender.timing(size)),
        peak_mb=peak_mb,
        parameters=contender.denoiser.parameter_count() if is_ours else None,
        macs_per_pixel=macs_per_pixel(spec),
        prediction=contender.share_of_network(),
    )


def devices() -> list[str]:
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def results_file(runs: Path, device: str = "cpu") -> Path:
    """Where the times on a device ("cpu" or "cuda") are kept."""
    return runs / "bench" / ("results.json" if device == "cpu" else f"results-{device}.json")


def bench_denoisers(runs: Path, names: Sequence[str], sizes: Sequence[str], threads: Sequence[int] = ()) -> str:
    """Measure the named denoisers, or all that can run here: a table, and RUNS/bench/results.json.

    On the CPU with each number of `threads`; then, where there is one, on the GPU, into RUNS/bench/results-cuda.json.
    Goes on where the same call was interrupted. Raises BadInput for unknown names, sizes and numbers of threads.
    """
    pixels = [parse_size(size) for size in dict.fromkeys(sizes)]
    counts = thread_counts(threads)
    specs = {device: ways(names, device) for device in devices()}
    (runs / "bench").mkdir(parents=True, exist_ok=True)
    tables = []
    for device, ours in specs.items():
        path = results_file(runs, device)
        unfinished = path.with_name(f"unfinished-{path.name}")
        rows = measure_all(ours, pixels, counts if device == "cpu" else counts[-1:], unfinished)
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


def measure_all(
    specs: Sequence[DenoiserSpec], sizes: Sequence[Size], counts: Sequence[int], unfinished: Path
) -> list[Row]:
    """The rows of results.json: size by size, and in each by rising numbers of threads.

    Each race is kept in the file `unfinished`, and not run again where that is of the same denoisers, code and device.
    """
    modules = {module for spec in specs for module in spec.modules}
    call = {
        "specs": [repr(spec) for spec in specs],
        "code": code_digest(__name__, *sorted(modules)),
        "versions": versions(DENOISING),
        "device": device_in_words(specs[0].device),
    }
    before = read_json(unfinished, ("call", "rows")) if unfinished.exists() else {}
    rows = [Row(**row) for row in before["rows"]] if before.get("call") == call else []
    done = {row.race for row in rows}
    for size in sizes:
        left = [count for count in counts if (*size, count) not in done]
        memory = peaks(specs, size, counts[-1]) if left else []
        for count in left:
            with thread_count(count):
                rows += [row(contender, size, peak) for contender, peak in zip(race(specs, size), memory, strict=True)]
            write_json(unfinished, {"call": call, "rows": [asdict(row) for row in rows]})
    wanted = [(*size, count) for size in sizes for count in counts]
    return [row for key in wanted for row in rows if row.race == key]


def table_lines(rows: Sequence[Row]) -> Iterator[dict[str, Any]]:
    """The rows for people: times next to OIDN's, and how they divide between the network and the rest."""
    baselines = {row.race: row.ms_median for row in rows if row.denoiser == OIDN}
    for row in rows:
        baseline = baselines.get(row.race)
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
            "prediction": f"{share:.0%}" if share is not None else None,
            "reconstruction": f"{1 - share:.0%}" if share is not None else None,
            "peak MB": row.peak_mb,
            "parameters": row.parameters,
            "as trained": create(row.denoiser).parameter_count() if share is not None else None,
            "MACs/pixel": row.macs_per_pixel,
        }
