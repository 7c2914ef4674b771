"""`onespp bench denoisers`: what a frame costs, from noisy Frame to radiance, next to OIDN in the same run."""

import re
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tabulate import tabulate
from torch import Tensor, nn
from tqdm import tqdm

from datasets.frame import Frame
from errors import BadInput
from eval.bench.memory import alone, growth_mb, release
from eval.bench.synthetic_frames import synthetic_frame
from eval.results import BASELINES, code, versions
from eval.results import SOURCES as EVALUATED
from eval.results import device as in_words
from eval.sizes import SIZES, WHOLE, create_any, timed_as
from files import read_json, write_json
from models import compiled
from models.denoiser import Denoiser, State
from models.oidn import OIDN
from models.registry import DENOISERS, create, unavailable
from models.taa import inner_denoiser

BASELINE, FAST = "oidn", "oidn (fast)"
COMPILED = ("accumulated", "eaw", "svgf")  # filters that are also measured the PyTorch way
PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
SOURCES = (
    *EVALUATED,
    "eval/bench/denoisers.py",
    "eval/bench/memory.py",
    "eval/bench/synthetic_frames.py",
)  # what times follow from
WARM_UP, REPEATS = 2, 10  # frames
FEWEST, PATIENCE = 5, 240.0  # of frames measured, where all denoisers together take longer than these seconds
COUNTING_SIZE = 128  # px; a side that no network needs to pad

Size = tuple[int, int]  # height, width


class Variant(NamedTuple):
    """A denoiser in one of the ways it can run. Networks have fresh weights: speed does not depend on training."""

    label: str
    name: str
    dtype: str = "float32"
    compiled: bool = True
    indirect: bool = False  # a baseline, on indirect light alone
    device: str = "cpu"

    def build(self) -> Denoiser:
        """As it stands before `prepare`."""
        torch.manual_seed(0)
        if self.indirect:
            return create(self.name, "indirect")
        return OIDN("fast") if self.label == FAST else create_any(self.name)

    def way(self) -> AbstractContextManager[None]:
        return nullcontext() if self.compiled else compiled.disabled()


def variants(names: Sequence[str], device: str = "cpu") -> list[Variant]:
    """All ways to run the named denoisers, or else all that can run here, networks of other sizes too.

    Raises BadInput where a named one is unknown or cannot run.
    """
    found = []
    baseline = () if unavailable(BASELINE) else (BASELINE,)
    everyone = (*DENOISERS, *(size for size in SIZES if size != WHOLE))
    for name in dict.fromkeys((*names, *baseline)) if names else everyone:
        if name not in SIZES and (reason := unavailable(name)):
            if names:
                raise BadInput(reason)
            print(f"{name}: skipped, {reason}")
            continue
        denoiser = create_any(name)
        dtypes = [dtype for dtype, precision in PRECISIONS.items() if precision not in denoiser.refuses]
        found += [Variant(name, name, dtype, device=device) for dtype in dtypes]
        if name in COMPILED and device == "cpu":  # elsewhere PyTorch is the only way
            found.append(Variant(f"{name} (PyTorch)", name, compiled=False))
        if name in BASELINES:
            found.append(Variant(timed_as(name, "indirect"), name, indirect=True, device=device))
        found += [Variant(FAST, name, device=device)] if name == BASELINE else []
    return found


@dataclass
class Contender:
    """One variant on its way through the sequence."""

    variant: Variant
    denoiser: Denoiser
    state: State | None = None
    seconds: list[float] = field(default_factory=list)  # a frame
    in_network: list[float] = field(default_factory=list)  # of that; empty without a network

    @staticmethod
    def of(variant: Variant) -> "Contender":
        denoiser = variant.build()
        denoiser.prepare(PRECISIONS[variant.dtype])
        denoiser.to(variant.device)
        contender = Contender(variant, denoiser)
        if network := network_of(denoiser):
            network.register_forward_pre_hook(lambda *_: contender.in_network.append(-contender.clock()))
            network.register_forward_hook(lambda *_: contender.leave_network())
        return contender

    def clock(self) -> float:
        """Seconds, once the device has done all that it was given."""
        if self.variant.device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def leave_network(self) -> None:
        self.in_network[-1] += self.clock()

    def step(self, frame: Frame) -> None:
        """Denoise the next frame, which is on the device already."""
        with self.variant.way():
            start = self.clock()
            _, self.state = self.denoiser(frame, self.state)
            self.seconds.append(self.clock() - start)

    def play(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            self.step(frame)

    def timing(self, size: Size) -> dict[str, Any]:
        """What was measured, in the form of results.json."""
        height, width = size
        p10, median, p90 = (float(ms) for ms in 1e3 * np.percentile(self.seconds[WARM_UP:], (10, 50, 90)))
        return {
            **{"denoiser": self.variant.label, "height": height, "width": width, "dtype": self.variant.dtype},
            **{"threads": torch.get_num_threads(), "frames": len(self.seconds) - WARM_UP},
            **{"ms_median": median, "ms_p10": p10, "ms_p90": p90},
        }

    def row(self, size: Size, peak: float | None) -> dict[str, Any]:
        """A row of results.json. `peak` is the memory it takes, in MB."""
        return {
            **self.timing(size),
            "peak_mb": peak,
            "parameters": None if isinstance(inner_denoiser(self.denoiser), OIDN) else self.denoiser.parameter_count(),
            "macs_per_pixel": macs_per_pixel(self.variant),
            "prediction": self.share_of_network(),
        }

    def share_of_network(self) -> float | None:
        if not self.in_network:
            return None
        return float(np.median(np.divide(self.in_network, self.seconds)[WARM_UP:]))


def network_of(denoiser: Denoiser) -> nn.Module | None:
    network = getattr(inner_denoiser(denoiser), "network", None)
    return network if isinstance(network, nn.Module) else None


@torch.inference_mode()
def macs_per_pixel(variant: Variant) -> float | None:
    """Multiply-accumulates of the network's convolutions a pixel, in the form for inference; None without a network."""
    denoiser = variant.build()
    denoiser.prepare()
    network, macs = network_of(denoiser), 0

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
def peak_memory(variant: Variant, frames: Sequence[Frame], threads: int) -> float | None:
    """What two frames of a sequence add to resident memory, or to the GPU's, in MB, in a fresh process.

    That is the state and everything in between, without the frame itself, the weights and the code.
    """
    torch.set_num_threads(threads)
    contender = Contender.of(variant)
    contender.step(synthetic_frame(0, COUNTING_SIZE, COUNTING_SIZE).to(variant.device))  # loads and compiles
    contender.state = None
    # What comes from another process is resident once touched.
    frames = [frame.map(torch.clone).to(variant.device) for frame in frames]
    if variant.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        contender.play(frames)
        return (torch.cuda.max_memory_allocated() - before) / 1e6
    return growth_mb(lambda: contender.play(frames))


def peaks(variants: Sequence[Variant], size: Size, threads: int) -> list[float | None]:
    """The peak memory of each variant, in MB, each in a process of its own."""
    frames = [synthetic_frame(index, *size) for index in range(2)]
    return [alone(peak_memory, variant, frames, threads) for variant in tqdm(variants, "memory", leave=False)]


@contextmanager
def thread_count(threads: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@torch.inference_mode()
def race(variants: Sequence[Variant], size: Size) -> list[Contender]:
    """Time all variants on one sequence: each frame by each of them in turn, so that drift of the machine hits all.

    After PATIENCE it ends with less than REPEATS frames, but at least FEWEST.
    """
    release()  # what earlier races took: all these states of 1920 x 1080 fill most of 24 GB
    contenders = [Contender.of(variant) for variant in variants]
    end = time.perf_counter() + PATIENCE
    with tqdm(total=(WARM_UP + REPEATS) * len(contenders), desc=f"{size[1]}x{size[0]}", leave=False) as progress:
        for index in range(WARM_UP + REPEATS):
            frame = synthetic_frame(index, *size).to(variants[0].device)
            for contender in contenders:
                progress.set_postfix_str(contender.variant.label)
                contender.step(frame)
                progress.update()
            if index + 1 >= WARM_UP + FEWEST and time.perf_counter() > end:
                break
    return contenders


def parse_size(text: str) -> Size:
    """(height, width) of "1280x720". Raises BadInput."""
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not match:
        raise BadInput(f"'{text}' is not a size such as 1280x720")
    return int(match[2]), int(match[1])


def thread_counts(threads: Sequence[int]) -> list[int]:
    """The numbers of threads to measure with, rising; by default one, and as many as PyTorch takes.

    Raises BadInput for a number that cannot work.
    """
    for count in threads:
        if count < 1:
            raise BadInput(f"{count} threads cannot work: name at least 1")
    return sorted({*threads} or {1, torch.get_num_threads()})


def devices() -> list[str]:
    return ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]


def bench_denoisers(runs: Path, names: Sequence[str], sizes: Sequence[str], threads: Sequence[int] = ()) -> str:
    """Measure the named denoisers, or all that can run here: a table, and RUNS/bench/results.json.

    On the CPU with each number of `threads`; then, where there is one, on the GPU, into RUNS/bench/results-cuda.json.
    Goes on where the same call was interrupted. Raises BadInput for unknown names, sizes and numbers of threads.
    """
    pixels, counts = [parse_size(size) for size in dict.fromkeys(sizes)], thread_counts(threads)
    entrants = {device: variants(names, device) for device in devices()}
    (runs / "bench").mkdir(parents=True, exist_ok=True)
    tables = []
    for device, ours in entrants.items():
        path = runs / "bench" / ("results.json" if device == "cpu" else f"results-{device}.json")
        unfinished = path.with_name(f"unfinished-{path.name}")
        rows = measure(ours, pixels, counts if device == "cpu" else counts[-1:], unfinished)
        # The number at the top is of the last rows of each size.
        write_json(path, {"schema": 1, "device": in_words(device, counts[-1]), "threads": counts[-1], "rows": rows})
        unfinished.unlink()
        tables.append(f"{device}\n{tabulate(table_lines(rows), 'keys', floatfmt='.3g', missingval='-')}")
    return "\n\n".join(tables)


def measure(
    entrants: Sequence[Variant], sizes: Sequence[Size], counts: Sequence[int], unfinished: Path
) -> list[dict[str, Any]]:
    """The rows of results.json: size by size, and in each by rising numbers of threads.

    Each race is kept in the file `unfinished`, and not run again where that is of the same denoisers, code and device.
    """
    facts = {"code": code(SOURCES), "versions": versions(), "device": in_words(entrants[0].device)}
    call = {"entrants": [repr(variant) for variant in entrants], **facts}
    before = read_json(unfinished, ("call", "rows")) if unfinished.exists() else {}
    rows: list[dict[str, Any]] = before["rows"] if before.get("call") == call else []
    done = {race_of(row) for row in rows}
    for size in sizes:
        left = [count for count in counts if (*size, count) not in done]
        memory = peaks(entrants, size, counts[-1]) if left else []
        for count in left:
            with thread_count(count):
                rows += [c.row(size, peak) for c, peak in zip(race(entrants, size), memory, strict=True)]
            write_json(unfinished, {"call": call, "rows": rows})
    wanted = [(*size, count) for size in sizes for count in counts]
    return [row for key in wanted for row in rows if race_of(row) == key]


def table_lines(rows: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The rows for people: times next to OIDN's, and how they divide between the network and the rest."""
    baselines = {race_of(row): row["ms_median"] for row in rows if row["denoiser"] == BASELINE}
    for row in rows:
        baseline, share = baselines.get(race_of(row)), row["prediction"]
        yield {
            **{"denoiser": row["denoiser"], "size": f"{row['width']}x{row['height']}", "dtype": row["dtype"]},
            "threads": row["threads"],
            **{"ms": row["ms_median"], "p10": row["ms_p10"], "p90": row["ms_p90"]},
            "times oidn": row["ms_median"] / baseline if baseline else None,
            "prediction": f"{share:.0%}" if share is not None else None,
            "reconstruction": f"{1 - share:.0%}" if share is not None else None,
            "peak MB": row["peak_mb"],
            "parameters": row["parameters"],
            "as trained": create_any(row["denoiser"]).parameter_count() if share is not None else None,
            "MACs/pixel": row["macs_per_pixel"],
        }


def race_of(row: dict[str, Any]) -> tuple[int, int, int]:
    return row["height"], row["width"], row["threads"]
