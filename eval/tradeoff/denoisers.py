"""Quality against time by denoiser and precision: the rows of trade.json and their table."""

from collections.abc import Sequence
from dataclasses import dataclass

from tabulate import tabulate

from datasets.frame import Signal
from eval.means import scores_of
from eval.metrics import METRICS, Values
from eval.results import ClipResults, by_signal
from eval.text_table import LEGEND, NEAR_FLOOR, value_cell
from eval.tradeoff.candidates import trained_epochs
from eval.tradeoff.pareto import Point, TimedScores, dominated_by_name
from eval.tradeoff.times import Times
from models.spec import DenoiserSpec

TRADED = ("psnr", "ssim", "rmse")


@dataclass(frozen=True)
class Trade:
    """A denoiser in one precision, compared with all others that return the same signal.

    Attributes:
        label: its unique name.
        dtype: the precision, a key of PRECISIONS.
        epochs: of its training; None where unknown, or without training.
        ms: milliseconds per frame; None where not measured.
        metrics: means over the clips.
        floors: noise floors of means that are within them.
        compared: the values of TRADED by which it is ranked.
        dominated_by: the denoiser that dominates it in each of TRADED; None on the front, and without a time or value.
    """

    label: str
    denoiser: str
    dtype: str
    signal: Signal
    epochs: int | None
    ms: float | None
    metrics: Values
    floors: Values
    compared: Values
    dominated_by: dict[str, str | None]

    def point(self, metric: str) -> Point | None:
        """Its position in plots."""
        return Point.of(self.ms, self.metrics[metric])

    def standing(self, metric: str) -> str:
        """The denoiser that dominates it, "front", or "-" without a time or value."""
        return (self.dominated_by[metric] or "front") if self.point(metric) else "-"


def trades(specs: Sequence[DenoiserSpec], clips: Sequence[ClipResults], times: Times) -> list[Trade]:
    """One row per spec, whose label is the name of its results on the clips."""
    offers: dict[Signal, dict[str, TimedScores]] = {}
    for signal, ours in by_signal(clips).items():
        alike = [spec for spec in specs if spec.returns == signal]
        offers[signal] = {spec.label: TimedScores(times.of(spec), scores_of(ours, spec.label)) for spec in alike}
    beaten = {(signal, metric): dominated_by_name(offers[signal], metric) for signal in offers for metric in TRADED}
    rows = []
    for spec in specs:
        offer = offers[spec.returns][spec.label]
        rows.append(
            Trade(
                label=spec.label,
                denoiser=spec.name,
                dtype=spec.precision,
                signal=spec.returns,
                epochs=trained_epochs(spec),
                ms=offer.ms,
                metrics=offer.scores.means,
                floors=offer.scores.joint_floor,
                compared={metric: offer.scores.compared(metric) for metric in TRADED},
                dominated_by={metric: beaten[spec.returns, metric].get(spec.label) for metric in TRADED},
            )
        )
    return rows


def front_table(rows: Sequence[Trade]) -> str:
    """One line per row, fastest first, with the denoiser that dominates it in each metric or "front"."""
    lines = []
    for row in sorted(rows, key=lambda row: (row.ms is None, row.ms)):
        line = {
            "denoiser": row.denoiser,
            "dtype": row.dtype,
            "epochs": row.epochs or "-",
            "ms": "-" if row.ms is None else f"{row.ms:.4g}",
        }
        line |= {METRICS[key].title: value_cell(key, row.metrics[key], row.floors.get(key)) for key in TRADED}
        line |= {f"dominated in {METRICS[key].title.split()[0]} by": row.standing(key) for key in TRADED}
        lines.append(line)
    text = tabulate(lines, "keys", disable_numparse=True)
    return f"{text}\n{LEGEND}" if NEAR_FLOOR in text else text
