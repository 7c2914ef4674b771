"""Quality against samples a pixel: whether milliseconds are better spent on samples or on the filter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.frame import Signal
from errors import BadInput
from eval.bench.sample_cost import Cost, sample_cost
from eval.harness import entrant, evaluate_clip
from eval.means import scores_of
from eval.metrics import METRICS, Values
from eval.results import ClipResults, Result, by_clip, by_signal
from eval.selection import with_indirect_baselines
from eval.spec import DenoiserSpec, precision_in_use
from eval.text_table import value_cell
from eval.tradeoff.pareto import Offer, beaten_by
from eval.tradeoff.resampled_clips import Source, scene_of, source, with_samples
from eval.tradeoff.times import Times
from render.clip import Options

SPP_LEVELS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
SAMPLED = ("noisy", "accumulated", "svgf", "oidn", "rae", "wskp6", "ntd")  # unless denoisers are named

# The table after RAE §5.4: who is compared, fed how many samples a pixel, and by what.
GENERALISED = ("noisy", "accumulated", "svgf", "rae")
FED = (1, 4, 256)
FED_METRICS = ("psnr", "ssim", "rmse")


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


@dataclass(frozen=True)
class SampleTrades:
    """What trade.json says of samples a pixel.

    Attributes:
        levels: the numbers of samples.
        sources: how each clip's input was made.
        render_ms: the cost of samples in each clip's scene.
    """

    levels: list[int]
    sources: dict[str, Source]
    render_ms: dict[str, dict[str, float]]
    rows: list[SampleTrade]


def name_of(label: str, spp: int) -> str:
    return f"{label}, {spp} spp"


def check_levels(levels: Sequence[int]) -> None:
    """Raise BadInput unless they are at least 1 and rise."""
    if not levels or levels[0] < 1 or any(a >= b for a, b in pairwise(levels)):
        raise BadInput(f"{' '.join(map(str, levels))} are no samples a pixel to compare: name rising numbers from 1")


def sampled(chosen: Sequence[DenoiserSpec], named: bool) -> list[DenoiserSpec]:
    """A few of the candidates, or all that were named, each in the precision that `onespp eval` takes here."""
    return [
        candidate
        for candidate in chosen
        if (named or candidate.name in SAMPLED) and candidate.precision == precision_in_use(candidate.name)
    ]


def results_by_spp(
    specs: Sequence[DenoiserSpec], clips: Sequence[Clip], dataset: Dataset, levels: Sequence[int], folder: Path
) -> dict[int, list[ClipResults]]:
    """Results on the clips by samples a pixel. What is rendered and judged is kept in `folder`."""
    entrants = [entrant(spec, spec.label) for spec in specs]
    results: dict[int, list[Result]] = {spp: [] for spp in levels}
    jobs = [(clip, spp) for clip in clips for spp in levels]
    for clip, spp in tqdm(jobs, "samples a pixel", unit="clip"):
        fed = with_samples(clip, dataset, spp, source(clip, levels[-1]), folder / "data")
        results[spp] += evaluate_clip(fed, entrants, folder)
    return {spp: list(by_clip(found)) for spp, found in results.items()}


def costs(clips: Sequence[Clip], dataset: Dataset, times: Times) -> dict[str, Cost]:
    """What samples of each clip's scene cost at the size and with the threads of the bench."""
    options = Options(**dataset.facts["options"])
    return {
        f"{clip.scene}/{clip.name}": sample_cost(scene_of(clip, dataset)[0], *times.size, times.threads, options)
        for clip in tqdm(clips, f"rendering {times.name}", unit="scene", leave=False)
    }


def sample_trades(
    specs: Sequence[DenoiserSpec],
    fed: Mapping[int, Sequence[ClipResults]],
    render_ms: Mapping[int, float],
    times: Times,
) -> list[SampleTrade]:
    """A row for each of the specs at each number of samples a pixel, from what it made of the clips `fed` with those.

    `render_ms` is the mean time in which so many samples are rendered.
    """
    offers: dict[Signal, dict[str, Offer]] = {spec.returns: {} for spec in specs}
    for spp, clips in fed.items():
        ours = by_signal(clips)
        for spec in specs:
            filter_ms = times.of(spec)
            ms = None if filter_ms is None else render_ms[spp] + filter_ms
            offers[spec.returns][name_of(spec.label, spp)] = Offer(ms, scores_of(ours[spec.returns], spec.label))
    beaten = {signal: beaten_by(alike, "psnr") for signal, alike in offers.items()}
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


def by_samples(
    chosen: Sequence[DenoiserSpec],
    clips: Sequence[Clip],
    dataset: Dataset,
    levels: Sequence[int],
    times: Times,
    folder: Path,
) -> SampleTrades:
    """Feed the chosen denoisers the clips with each number of samples a pixel of `levels`, and weigh the results."""
    specs = with_indirect_baselines(chosen)
    fed = results_by_spp(specs, clips, dataset, levels, folder)
    cost = costs(clips, dataset, times)
    render_ms = {spp: float(np.mean([clip_cost.of(spp) for clip_cost in cost.values()])) for spp in levels}
    return SampleTrades(
        levels=[*levels],
        sources={f"{clip.scene}/{clip.name}": source(clip, levels[-1]) for clip in clips},
        render_ms={name: clip_cost._asdict() for name, clip_cost in cost.items()},
        rows=sample_trades(specs, fed, render_ms, times),
    )


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
        [row.label, row.spp, *(row.cell(metric) for metric in FED_METRICS)]
        for row in sorted(ours, key=lambda row: (row.spp, GENERALISED.index(row.denoiser)))
    ]
    head = ["denoiser", "spp", *(METRICS[metric].title for metric in FED_METRICS)]
    return tabulate(lines, head, disable_numparse=True)
