"""Quality against time: times from `onespp bench denoisers`, Pareto fronts, the rows of trade.json, their tables."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from tabulate import tabulate

from datasets.frame import Signal
from errors import BadInput
from eval.bench.denoisers import Size, results_file, size_name, timed_with
from eval.metrics import METRICS, Values
from eval.results import ClipResults, by_signal
from eval.tables import scores_of, source_of_denoiser, value_cell, with_legend
from files import read_json
from models.spec import DenoiserSpec
from provenance import device_in_words

TRADED = ("psnr", "ssim", "rmse")


class Times:
    """Milliseconds per frame of `size`, measured with `threads`, by default the most of the bench.

    `device` is "cpu" or "cuda". Raises BadInput where the bench has no such rows.
    """

    def __init__(self, runs: Path, size: Size, threads: int | None = None, device: str = "cpu"):
        path = results_file(runs, device)
        self.path = path
        self.kind = device
        self.size = size
        self.name = size_name(size)
        self.runs = runs
        if not path.exists():
            command = f"onespp bench denoisers --size {self.name} --runs {runs}"
            raise BadInput(f"there are no times at {path}: measure them with `{command}`")
        bench = read_json(path, ("device", "threads", "rows"))
        self.device: str = bench["device"]
        self.most_threads: int = bench["threads"]
        self.threads: int = threads or self.most_threads
        self.rows: list[dict[str, Any]] = bench["rows"]
        # By the bench's name of the denoiser, and precision.
        self.ms: dict[tuple[str, str], float] = {
            (row["denoiser"], row["dtype"]): row["ms_median"]
            for row in self.rows
            if (row["height"], row["width"], row["threads"]) == (*size, self.threads)
        }
        if not self.ms:
            raise BadInput(
                f"{path} has no times of {self.name} with {self.threads} threads: measure them with "
                f"`{self.command()}`, or name a size that it has with --size"
            )

        # Of code or packages that have changed since; files of older versions do not tell.
        self.warnings: list[str] = []
        here = timed_with()
        if bench.get("made_by", here) != here:
            self.warnings = [f"{path} has times of other code or packages: measure again with `{self.command()}`"]

    def check_device(self) -> None:
        """Raise BadInput where they were measured on another device than that of this process."""
        here = device_in_words(self.kind, self.most_threads)
        if self.device != here:
            raise BadInput(
                f"{self.path} has times of {self.device}, which do not compare with rendering on {here}: measure them "
                f"here with `{self.command()}`"
            )

    def command(self, names: Iterable[str] = ()) -> str:
        """The call of the bench for the named denoisers and, as it replaces results, for all that were timed."""
        denoisers = dict.fromkeys((*(row["denoiser"].partition(" (")[0] for row in self.rows), *names))
        sizes = dict.fromkeys((*(size_name((row["height"], row["width"])) for row in self.rows), self.name))
        threads = sorted({*(row["threads"] for row in self.rows), self.threads})
        options = f"--size {' '.join(sizes)} --threads {' '.join(map(str, threads))} --runs {self.runs}"
        return f"onespp bench denoisers {' '.join(denoisers)} {options}"

    def of(self, spec: DenoiserSpec) -> float | None:
        """Milliseconds a frame; None where that was not measured."""
        return self.ms.get((spec.way, spec.precision))


def times_of_first_size(runs: Path) -> Times | None:
    """The times on the CPU at the bench's first size; None without any."""
    path = results_file(runs)
    rows = read_json(path, ("rows",))["rows"] if path.exists() else []
    return Times(runs, (rows[0]["height"], rows[0]["width"])) if rows else None


def dominated_by_name(points: Mapping[str, tuple[float | None, float | None]], metric: str) -> dict[str, str | None]:
    """For every name, the best of those that are no slower and no worse, and better in one; None on the front.

    `points` are milliseconds and values of the metric. Names without either are left out.
    """
    sign = -1 if METRICS[metric].more_is_better else 1
    costs = {name: (sign * value, ms) for name, (ms, value) in points.items() if ms is not None and value is not None}
    best_first = sorted(costs, key=costs.__getitem__)

    def dominates(a: tuple[float, float], b: tuple[float, float]) -> bool:
        return a[0] <= b[0] and a[1] <= b[1] and a != b

    return {
        name: next((other for other in best_first if dominates(costs[other], cost)), None)
        for name, cost in costs.items()
    }


@dataclass(frozen=True)
class Trade:
    """A denoiser in one precision with `spp` samples per pixel, compared with all others of the same signal."""

    name: str  # unique among those with which it is compared
    label: str  # of the denoiser, its precision and signal
    denoiser: str
    dtype: str  # the precision, a key of PRECISIONS
    signal: Signal
    spp: int
    render_ms: float  # of the samples; 0 where denoisers alone are compared
    filter_ms: float | None  # of the denoiser; None, like their sum `ms`, where not measured
    ms: float | None
    metrics: Values  # means over the clips
    floors: Values  # noise floors of means that are within them
    compared: Values  # the values of TRADED by which it is ranked
    # the name that dominates it in each of TRADED; None on the front, and without a time or value
    dominated_by: dict[str, str | None]

    def standing(self, metric: str) -> str:
        """The name that dominates it, "front", or "-" without a time or value."""
        if self.ms is None or self.metrics[metric] is None:
            return "-"
        return self.dominated_by[metric] or "front"

    def cell(self, metric: str) -> str:
        return value_cell(metric, self.metrics[metric], self.floors.get(metric))


def trades(
    specs: Sequence[DenoiserSpec],
    results: Mapping[int, Sequence[ClipResults]],
    render_ms: Mapping[int, float],
    times: Times,
) -> list[Trade]:
    """One row per number of samples per pixel and spec, whose label is the name of its results on the clips.

    `results` and `render_ms`, the mean time of rendering, are by number of samples.
    """
    rows = []
    for spp, spec in product(results, specs):
        name = spec.label if len(results) == 1 else f"{spec.label}, {spp} spp"
        scores = scores_of(by_signal(results[spp])[spec.returns], spec.label)
        filter_ms = times.of(spec)
        row = Trade(
            name=name,
            label=spec.label,
            denoiser=spec.name,
            dtype=spec.precision,
            signal=spec.returns,
            spp=spp,
            render_ms=render_ms[spp],
            filter_ms=filter_ms,
            ms=None if filter_ms is None else render_ms[spp] + filter_ms,
            metrics=scores.means,
            floors=scores.joint_floor,
            compared={metric: scores.compared(metric) for metric in TRADED},
            dominated_by={},
        )
        rows.append(row)
    for signal, metric in product(dict.fromkeys(row.signal for row in rows), TRADED):
        alike = [row for row in rows if row.signal == signal]
        beaten = dominated_by_name({row.name: (row.ms, row.compared[metric]) for row in alike}, metric)
        for row in alike:
            row.dominated_by[metric] = beaten.get(row.name)
    return rows


def front_table(rows: Sequence[Trade]) -> str:
    """One line per row, fastest first, with the denoiser that dominates it in each metric or "front"."""
    lines = []
    for row in sorted(rows, key=lambda row: (row.ms is None, row.ms)):
        line = {"denoiser": row.denoiser, "made from": source_of_denoiser(row.denoiser), "dtype": row.dtype}
        line |= {"ms": "-" if row.ms is None else f"{row.ms:.4g}"}
        line |= {METRICS[metric].title: row.cell(metric) for metric in TRADED}
        line |= {f"dominated in {METRICS[metric].title.split()[0]} by": row.standing(metric) for metric in TRADED}
        lines.append(line)
    return with_legend(tabulate(lines, "keys", disable_numparse=True))


def psnr_front(rows: Sequence[Trade], signal: Signal) -> list[tuple[float, Trade]]:
    """The front of PSNR of a signal, as (milliseconds, row), fastest first."""
    timed = [(row.ms, row) for row in rows if row.signal == signal and row.ms is not None]
    return sorted(((ms, row) for ms, row in timed if row.standing("psnr") == "front"), key=lambda step: step[0])


def samples_table(rows: Sequence[Trade]) -> str:
    """PSNR of each denoiser at each number of samples, and the front of PSNR against milliseconds."""
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        facts = {"signal": row.signal, "denoiser": row.label, "made from": source_of_denoiser(row.denoiser)}
        line = lines.setdefault((row.signal, row.label), facts)
        line[f"{row.spp} spp"] = row.cell("psnr")
    text = f"PSNR dB\n{tabulate([*lines.values()], 'keys', disable_numparse=True)}"
    for signal in dict.fromkeys(row.signal for row in rows):
        steps = (f"{row.name} ({ms:.4g} ms, {row.cell('psnr')} dB)" for ms, row in psnr_front(rows, signal))
        text += f"\n\nPareto front, {signal} light: {'; '.join(steps)}"
    return text
