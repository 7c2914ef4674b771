"""Denoisers with more samples per pixel: whether milliseconds are better spent on samples or on the filter."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from tqdm import tqdm

from datasets.channels import SAMPLE_BUFFERS
from datasets.clip import Clip, Dataset
from errors import BadInput
from eval.bench.sample_cost import Cost, sample_cost
from eval.clip_run import NamedDenoiser
from eval.harness import evaluate_clip
from eval.results import ClipResults, Result, by_clip
from eval.selection import baselines, with_indirect_baselines
from eval.tradeoff.resampled_clips import Source, scene_of, source, with_samples
from eval.tradeoff.samples import SampleTrade, sample_trades
from eval.tradeoff.shrinkage import Gain, gains_of
from eval.tradeoff.times import Times
from models.shipped_weights import shipped_names
from models.spec import DenoiserSpec, fastest_precision
from render.clip import Options

SPP_LEVELS = (1, 2, 4, 8, 16, 32, 64, 128, 256)


@dataclass(frozen=True)
class SampleTrades:
    """The part of trade.json on samples per pixel.

    Attributes:
        levels: the numbers of samples.
        sources: how the input of each clip was made.
        render_ms: the cost of samples in the scene of each clip.
        shrinkage: the gains of NAME+js.
    """

    levels: list[int]
    sources: dict[str, Source]
    render_ms: dict[str, dict[str, float]]
    rows: list[SampleTrade]
    shrinkage: list[Gain]


def check_levels(levels: Sequence[int]) -> None:
    """Raise BadInput unless they are at least 1 and rise."""
    if not levels or levels[0] < 1 or any(a >= b for a, b in pairwise(levels)):
        raise BadInput(f"{' '.join(map(str, levels))} are no samples a pixel to compare: name rising numbers from 1")


def sampled(chosen: Sequence[DenoiserSpec], named: bool) -> list[DenoiserSpec]:
    """The named candidates, or baselines and networks with shipped weights, in the precision of `onespp eval`."""
    usual = (*baselines(), *shipped_names())
    return [
        candidate
        for candidate in chosen
        if (named or candidate.name in usual) and candidate.precision == fastest_precision(candidate.denoiser)
    ]


def results_by_spp(
    specs: Sequence[DenoiserSpec], clips: Sequence[Clip], dataset: Dataset, levels: Sequence[int], folder: Path
) -> dict[int, list[ClipResults]]:
    """Results on the clips by samples per pixel; clips and results are stored in `folder`."""
    denoisers = [NamedDenoiser(spec, spec.label) for spec in specs]
    with_buffers = any(not set(SAMPLE_BUFFERS.values()).isdisjoint(spec.facts.reads) for spec in specs)
    results: dict[int, list[Result]] = {spp: [] for spp in levels}
    jobs = [(clip, spp) for clip in clips for spp in levels]
    for clip, spp in tqdm(jobs, "samples a pixel", unit="clip"):
        fed = with_samples(clip, dataset, spp, source(clip, levels[-1]), folder / "data", with_buffers)
        results[spp] += evaluate_clip(fed, denoisers, folder)
    return {spp: list(by_clip(found)) for spp, found in results.items()}


def costs(clips: Sequence[Clip], dataset: Dataset, times: Times) -> dict[str, Cost]:
    """The cost of samples in the scene of each clip, at the size and with the threads of the bench."""
    options = Options(**dataset.facts["options"])
    return {
        f"{clip.scene}/{clip.name}": sample_cost(scene_of(clip, dataset)[0], *times.size, times.threads, options)
        for clip in tqdm(clips, f"rendering {times.name}", unit="scene", leave=False)
    }


def by_samples(
    chosen: Sequence[DenoiserSpec],
    clips: Sequence[Clip],
    dataset: Dataset,
    levels: Sequence[int],
    times: Times,
    folder: Path,
) -> SampleTrades:
    """Evaluate the chosen denoisers on the clips with each number of samples per pixel of `levels`."""
    specs = with_indirect_baselines(chosen)
    fed = results_by_spp(specs, clips, dataset, levels, folder)
    cost = costs(clips, dataset, times)
    render_ms = {spp: float(np.mean([clip_cost.of(spp) for clip_cost in cost.values()])) for spp in levels}
    return SampleTrades(
        levels=[*levels],
        sources={f"{clip.scene}/{clip.name}": source(clip, levels[-1]) for clip in clips},
        render_ms={name: clip_cost._asdict() for name, clip_cost in cost.items()},
        rows=sample_trades(specs, fed, render_ms, times),
        shrinkage=[*gains_of(fed)],
    )
