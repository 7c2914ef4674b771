"""Quality against time: the rows of trade.json and their tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

from tabulate import tabulate

from datasets.frame import Signal
from eval.means import scores_of
from eval.metrics import METRICS, Values
from eval.results import ClipResults, by_signal
from eval.text_table import LEGEND, NEAR_FLOOR, value_cell
from eval.tradeoff.pareto import Point, dominated_by_name
from eval.tradeoff.times import Times
from models.spec import DenoiserSpec

TRADED = ("psnr", "ssim", "rmse")


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
        beaten = dominated_by_name({row.name: Point.of(row.ms, row.compared[metric]) for row in alike}, metric)
        for row in alike:
            row.dominated_by[metric] = beaten.get(row.name)
    return rows


def front_table(rows: Sequence[Trade]) -> str:
    """One line per row, fastest first, with the denoiser that dominates it in each metric or "front"."""
    lines = []
    for row in sorted(rows, key=lambda row: (row.ms is None, row.ms)):
        line = {"denoiser": row.denoiser, "dtype": row.dtype, "ms": "-" if row.ms is None else f"{row.ms:.4g}"}
        line |= {METRICS[metric].title: row.cell(metric) for metric in TRADED}
        line |= {f"dominated in {METRICS[metric].title.split()[0]} by": row.standing(metric) for metric in TRADED}
        lines.append(line)
    text = tabulate(lines, "keys", disable_numparse=True)
    return f"{text}\n{LEGEND}" if NEAR_FLOOR in text else text


def psnr_front(rows: Sequence[Trade], signal: Signal) -> list[tuple[float, Trade]]:
    """The front of PSNR of a signal, as (milliseconds, row), fastest first."""
    timed = [(row.ms, row) for row in rows if row.signal == signal and row.ms is not None]
    return sorted(((ms, row) for ms, row in timed if row.standing("psnr") == "front"), key=lambda step: step[0])


def samples_table(rows: Sequence[Trade]) -> str:
    """PSNR of each denoiser at each number of samples, and the front of PSNR against milliseconds."""
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        line = lines.setdefault((row.signal, row.label), {"signal": row.signal, "denoiser": row.label})
        line[f"{row.spp} spp"] = row.cell("psnr")
    text = f"PSNR dB\n{tabulate([*lines.values()], 'keys', disable_numparse=True)}"
    for signal in dict.fromkeys(row.signal for row in rows):
        steps = (f"{row.name} ({ms:.4g} ms, {row.cell('psnr')} dB)" for ms, row in psnr_front(rows, signal))
        text += f"\n\nPareto front, {signal} light: {'; '.join(steps)}"
    return text
