"""Quality against samples per pixel and milliseconds: rows of trade.json and their table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tabulate import tabulate

from datasets.frame import Signal
from eval.means import scores_of
from eval.metrics import Values
from eval.results import ClipResults, by_signal
from eval.text_table import value_cell
from eval.tradeoff.pareto import TimedScores, dominated_by_name
from eval.tradeoff.times import Times
from models.spec import DenoiserSpec


@dataclass(frozen=True)
class SampleTrade:
    """A denoiser with `spp` samples per pixel, compared with all denoisers of the same signal at all levels.

    Attributes:
        label: its unique name.
        dtype: its precision, a key of PRECISIONS.
        ms: of rendering and filtering a frame; None, like `filter_ms`, where the filter was not timed.
        metrics: means over the clips.
        floors: noise floors of means that are within them.
        compared: the PSNR by which it is ranked.
        dominated_by: the name that dominates it in PSNR, "LABEL, N spp"; None on the front, and without a time.
    """

    label: str
    denoiser: str
    dtype: str
    signal: Signal
    spp: int
    render_ms: float
    filter_ms: float | None
    ms: float | None
    metrics: Values
    floors: Values
    compared: Values
    dominated_by: str | None

    @property
    def name(self) -> str:
        return name_of(self.label, self.spp)

    def cell(self, metric: str) -> str:
        return value_cell(metric, self.metrics[metric], self.floors.get(metric))


def name_of(label: str, spp: int) -> str:
    return f"{label}, {spp} spp"


def sample_trades(
    specs: Sequence[DenoiserSpec],
    fed: Mapping[int, Sequence[ClipResults]],
    render_ms: Mapping[int, float],
    times: Times,
) -> list[SampleTrade]:
    """One row per spec and number of samples per pixel.

    `fed` has the results on the clips, and `render_ms` the mean time of rendering, by number of samples.
    """
    offers: dict[Signal, dict[str, TimedScores]] = {spec.returns: {} for spec in specs}
    for spp, clips in fed.items():
        ours = by_signal(clips)
        for spec in specs:
            filter_ms = times.of(spec)
            ms = None if filter_ms is None else render_ms[spp] + filter_ms
            offers[spec.returns][name_of(spec.label, spp)] = TimedScores(ms, scores_of(ours[spec.returns], spec.label))
    beaten = {signal: dominated_by_name(alike, "psnr") for signal, alike in offers.items()}
    rows = []
    for spp in fed:
        for spec in specs:
            name = name_of(spec.label, spp)
            offer = offers[spec.returns][name]
            rows.append(
                SampleTrade(
                    label=spec.label,
                    denoiser=spec.name,
                    dtype=spec.precision,
                    signal=spec.returns,
                    spp=spp,
                    render_ms=render_ms[spp],
                    filter_ms=times.of(spec),
                    ms=offer.ms,
                    metrics=offer.scores.means,
                    floors=offer.scores.joint_floor,
                    compared={"psnr": offer.scores.compared("psnr")},
                    dominated_by=beaten[spec.returns].get(name),
                )
            )
    return rows


def samples_table(rows: Sequence[SampleTrade]) -> str:
    """PSNR of each denoiser at each number of samples, and the front of PSNR against milliseconds."""
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        line = lines.setdefault((row.signal, row.label), {"signal": row.signal, "denoiser": row.label})
        line[f"{row.spp} spp"] = row.cell("psnr")
    text = f"PSNR dB\n{tabulate([*lines.values()], 'keys', disable_numparse=True)}"
    for signal in dict.fromkeys(row.signal for row in rows):
        front_rows = [row for row in rows if (row.signal, row.dominated_by) == (signal, None)]
        front = sorted(((row.ms, row) for row in front_rows if row.ms is not None), key=lambda step: step[0])
        steps = (f"{row.name} ({ms:.4g} ms, {row.cell('psnr')} dB)" for ms, row in front)
        text += f"\n\nPareto front, {signal} light: {'; '.join(steps)}"
    return text
