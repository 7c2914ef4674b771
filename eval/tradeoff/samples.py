"""Quality against samples a pixel, and against milliseconds of rendering and filter: rows of trade.json and tables."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tabulate import tabulate

from datasets.frame import Signal
from eval.means import scores_of
from eval.metrics import METRICS, Values
from eval.results import ClipResults, by_signal
from eval.text_table import value_cell
from eval.tradeoff.denoisers import TRADED
from eval.tradeoff.pareto import TimedScores, dominated_by_name
from eval.tradeoff.times import Times
from models.spec import DenoiserSpec

# The table after RAE §5.4: who is compared, fed how many samples a pixel.
GENERALISED = ("noisy", "accumulated", "svgf", "rae")
FED = (1, 4, 256)


@dataclass(frozen=True)
class SampleTrade:
    """A denoiser fed `spp` samples a pixel, beside all that return the same signal, fed whatever.

    Attributes:
        label: its name among the denoisers.
        dtype: its precision, a key of PRECISIONS.
        ms: of rendering and filtering a frame; None, as `filter_ms` is, where the filter was not timed.
        metrics: means over the clips.
        floors: noise floors of means that are within them.
        compared: what PSNR is compared by.
        dominated_by: by whom it is beaten in PSNR, "LABEL, N spp"; None on the front, and without a time.
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
    """A row for each of the specs at each number of samples a pixel, from what it made of the clips `fed` with those.

    `render_ms` is the mean time in which so many samples are rendered.
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
    """PSNR of each denoiser at each number of samples, and below what is on the front of PSNR and milliseconds."""
    lines: dict[tuple[str, str], dict[str, str]] = {}
    for row in rows:
        line = lines.setdefault((row.signal, row.label), {"signal": row.signal, "denoiser": row.label})
        line[f"{row.spp} spp"] = row.cell("psnr")
    text = f"PSNR dB\n{tabulate([*lines.values()], 'keys', disable_numparse=True)}"
    for signal in dict.fromkeys(row.signal for row in rows):
        unbeaten = [row for row in rows if (row.signal, row.dominated_by) == (signal, None)]
        front = sorted(((row.ms, row) for row in unbeaten if row.ms is not None), key=lambda step: step[0])
        steps = (f"{row.name} ({ms:.4g} ms, {row.cell('psnr')} dB)" for ms, row in front)
        text += f"\n\nWorth the time, {signal} light: {'; '.join(steps)}"
    return text


def generalisation(rows: Sequence[SampleTrade]) -> str:
    """What RAE, trained on 1 spp, makes of more, beside filters that are not trained (RAE §5.4)."""
    ours = [row for row in rows if row.signal == "total" and row.denoiser in GENERALISED and row.spp in FED]
    lines = [
        [row.label, row.spp, *(row.cell(metric) for metric in TRADED)]
        for row in sorted(ours, key=lambda row: (row.spp, GENERALISED.index(row.denoiser)))
    ]
    head = ["denoiser", "spp", *(METRICS[metric].title for metric in TRADED)]
    return tabulate(lines, head, disable_numparse=True)
