"""`onespp trade`: quality against milliseconds, by denoiser, precision and samples per pixel."""

from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from tqdm import tqdm

from datasets.channels import SAMPLE_BUFFERS
from datasets.clip import Clip, Dataset
from errors import BadInput
from eval.bench.denoisers import parse_size
from eval.clip_run import NamedDenoiser
from eval.harness import clips_of_one_spp, evaluate_clip, writing
from eval.metrics import METRICS
from eval.results import ClipResults, Result, by_clip
from eval.selection import baselines, cannot_run, choose, untrained, weights_file, with_indirect_baselines
from eval.tradeoff.samples import RENDERER, Cost, sample_cost, scene_of, with_samples
from eval.tradeoff.trades import Times, Trade, front_table, samples_table, trades
from files import write_json
from models.registry import DENOISERS, DenoiserName, shipped_names
from models.spec import DenoiserSpec, fastest_precision, precisions_of
from plotting import DPI, Figure, plt, save_figure, ticker
from provenance import DENOISING, versions
from render.clip import Options

FRONTS = "Fronts count a clip within its noise floor as at the floor's edge: a worse mean can dominate a better one."


def trade(
    data: Path,
    runs: Path,
    budget: str,
    levels: Sequence[int],
    names: Sequence[str] = (),
    size: str | None = None,
    threads: int | None = None,
) -> str:
    """Evaluate all candidates on the test clips, with `levels` of samples per pixel.

    Returns tables; writes RUNS/report/trade.json and a figure. Times are those of RUNS/bench at `size`, by default that
    of the clips, and `threads`. Clips and results are stored in RUNS/trade and reused. Raises BadInput where there are
    no times or clips, for times of another device, a bad size or numbers of samples, and as `candidates`.
    """
    check_levels(levels)
    dataset = Dataset(data)
    clips = clips_of_one_spp(dataset)
    times = Times(runs, parse_size(size) if size else (clips[0].height, clips[0].width), threads, RENDERER)
    times.check_device()
    chosen = candidates(names, runs, budget)
    folder = runs / "trade"

    specs = with_indirect_baselines(chosen)
    rows = trades(specs, results_by_spp(specs, clips, dataset, (1,), folder), {1: 0.0}, times)
    fed = with_indirect_baselines(with_more_samples(chosen, bool(names)))
    results = results_by_spp(fed, clips, dataset, levels, folder)
    costs = sample_costs(clips, dataset, times)
    render_ms = {spp: float(np.mean([cost.of(spp) for cost in costs.values()])) for spp in levels}
    sample_rows = trades(fed, results, render_ms, times)

    title = f"{times.name}, {RENDERER}, {times.threads} threads; mean of {len(clips)} clips of {data}"
    figures = runs / "report" / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    save_figure(figures / "trade-samples.png", draw_samples(sample_rows, title))
    content = {
        "schema": 1,
        "dataset": str(data),
        "device": times.device,
        "versions": versions(DENOISING),
        "budget": budget,
        "clips": [f"{clip.scene}/{clip.name}" for clip in clips],
        "size": times.name,
        "threads": times.threads,
        "rows": [asdict(row) for row in rows],
        "render_ms": {name: cost._asdict() for name, cost in costs.items()},
        "samples": [asdict(row) for row in sample_rows],
    }
    write_json(runs / "report" / "trade.json", content)
    return tables(rows, sample_rows, title, times)


def check_levels(levels: Sequence[int]) -> None:
    """Raise BadInput unless they are at least 1 and rise."""
    if not levels or levels[0] < 1 or any(a >= b for a, b in pairwise(levels)):
        raise BadInput(f"{' '.join(map(str, levels))} are no samples a pixel to compare: name rising numbers from 1")


def candidates(names: Sequence[str], runs: Path, budget: str) -> list[DenoiserSpec]:
    """The named denoisers, or all that can run and are trained, in each precision that they compute in.

    Raises BadInput for an unknown name and one that cannot run or is not trained.
    """
    obstacles = (cannot_run, partial(untrained, runs, budget))
    return [
        DenoiserSpec(name, precision=precision, weights=weights_file(name, runs, budget))
        for name in choose(names, map(DenoiserName, DENOISERS), *obstacles)
        for precision in precisions_of(name)
    ]


def with_more_samples(chosen: Sequence[DenoiserSpec], named: bool) -> list[DenoiserSpec]:
    """The named candidates, or baselines and networks with shipped weights, in the usual precision, which is timed."""
    usual = (*baselines(), *shipped_names())
    return [
        candidate
        for candidate in chosen
        if (named or candidate.name in usual) and candidate.precision == fastest_precision(candidate.denoiser, RENDERER)
    ]


def results_by_spp(
    specs: Sequence[DenoiserSpec], clips: Sequence[Clip], dataset: Dataset, levels: Sequence[int], folder: Path
) -> dict[int, list[ClipResults]]:
    """Results on the clips by samples per pixel; clips and results are stored in `folder`.

    Raises BadInput where another process writes there.
    """
    denoisers = [NamedDenoiser(spec, spec.label) for spec in specs]
    with_buffers = any(not set(SAMPLE_BUFFERS.values()).isdisjoint(spec.facts.reads) for spec in specs)
    results: dict[int, list[Result]] = {spp: [] for spp in levels}
    jobs = [(clip, spp) for clip in clips for spp in levels]
    with writing(folder):
        for clip, spp in tqdm(jobs, "samples a pixel", unit="clip"):
            fed = with_samples(clip, dataset, spp, folder / "data", with_buffers)
            results[spp] += evaluate_clip(fed, denoisers, folder)
    return {spp: list(by_clip(ours)) for spp, ours in results.items()}


def sample_costs(clips: Sequence[Clip], dataset: Dataset, times: Times) -> dict[str, Cost]:
    """The cost of samples in the scene of each clip, at the size and with the threads of the bench."""
    options = Options(**dataset.facts["options"])
    return {
        f"{clip.scene}/{clip.name}": sample_cost(scene_of(clip, dataset)[0], *times.size, times.threads, options)
        for clip in tqdm(clips, f"rendering {times.name}", unit="scene", leave=False)
    }


def draw_samples(rows: Sequence[Trade], title: str) -> Figure:
    """PSNR against samples per pixel, and against milliseconds of rendering and filtering; one row per signal."""
    signals = list(dict.fromkeys(row.signal for row in rows))
    size = (11, 4.5 * len(signals))
    figure, axes = plt.subplots(len(signals), 2, figsize=size, dpi=DPI, layout="constrained", squeeze=False)
    for (left, right), signal in zip(axes, signals, strict=True):
        ours = [row for row in rows if row.signal == signal]
        for label in dict.fromkeys(row.label for row in ours):
            line = [row for row in ours if row.label == label]
            psnr = [row.metrics["psnr"] for row in line]
            (drawn,) = left.plot([row.spp for row in line], psnr, "o-", ms=4, lw=1.2, label=label)
            if all(row.ms is not None for row in line):
                right.plot([row.ms for row in line], psnr, "o-", ms=4, lw=1.2, color=drawn.get_color())
        left.set_xscale("log", base=2)
        left.set(xlabel="samples a pixel", ylabel=f"{METRICS['psnr'].title}, {signal} light")
        levels = sorted({row.spp for row in ours})
        left.set_xticks(levels, map(str, levels))
        right.set(xlabel="ms a frame, rendering and filter")
        right.set_xscale("log")
        right.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
        right.xaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))  # 2, 5, 10, 20 instead of powers
        right.xaxis.set_minor_formatter(ticker.NullFormatter())
        left.legend(fontsize=8)
        for axis in (left, right):
            axis.grid(alpha=0.3, which="both")
    figure.suptitle(title, fontsize=9)
    return figure


def tables(rows: Sequence[Trade], sample_rows: Sequence[Trade], title: str, times: Times) -> str:
    parts = [title, *times.warnings, FRONTS]
    for signal in dict.fromkeys(row.signal for row in rows):
        parts.append(f"{signal} light\n{front_table([row for row in rows if row.signal == signal])}")
    if untimed := [row.label for row in rows if row.ms is None]:
        command = f"{times.command(row.denoiser for row in rows)} --all"
        note = "" if RENDERER == "cpu" else "; OIDN computes on the CPU alone"
        parts.append(f"Without a time: {', '.join(untimed)}. Measure all with `{command}`{note}.")
    parts.append(f"samples per pixel\n{samples_table(sample_rows)}")
    return "\n\n".join(parts)
