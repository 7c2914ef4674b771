"""`onespp trade`: what quality costs in milliseconds, by denoiser, precision, size of network and samples a pixel."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from datasets.clip import Dataset
from eval.bench.sample_cost import RENDERER
from eval.bench.sizes import parse_size
from eval.clip_run import NamedDenoiser
from eval.harness import clips_of_one_spp, evaluate_clip
from eval.results import by_clip
from eval.selection import with_indirect_baselines
from eval.tradeoff.candidates import candidates
from eval.tradeoff.denoisers import TRADED, Trade, front_table, trades
from eval.tradeoff.feeding import SPP_LEVELS, SampleTrades, by_samples, check_levels, sampled
from eval.tradeoff.plots import draw_front, draw_samples
from eval.tradeoff.samples import generalisation, samples_table
from eval.tradeoff.shrinkage import gains_table
from eval.tradeoff.times import Times
from files import write_json
from plotting import save_figure
from provenance import DENOISING, device_in_words, versions

FRONTS = (
    "On fronts a clip within its noise floor counts as at its edge: so a mean can be beaten by one that looks worse."
)


def trade(
    data: Path,
    runs: Path,
    budget: str,
    names: Sequence[str] = (),
    size: str = "1280x720",
    threads: int | None = None,
    levels: Sequence[int] = SPP_LEVELS,
) -> str:
    """Judge all that can be traded on the test clips: tables, RUNS/report/trade.json and figures beside it.

    Times are those of RUNS/bench at `size` and `threads`. What was judged or rendered before is kept in RUNS/trade.
    Raises BadInput where there are no times or clips, for a bad size or numbers of samples, and as `candidates` does.
    """
    check_levels(levels)
    dataset = Dataset(data)
    times = Times(runs, parse_size(size), threads, RENDERER)
    clips = clips_of_one_spp(dataset)
    chosen = candidates(names, runs, budget)

    specs = with_indirect_baselines(chosen)
    denoisers = [NamedDenoiser(spec, spec.label) for spec in specs]
    results = [result for clip in clips for result in evaluate_clip(clip, denoisers, runs / "trade")]
    rows = trades(specs, list(by_clip(results)), times)
    samples = by_samples(sampled(chosen, bool(names)), clips, dataset, levels, times, runs / "trade")

    figures = runs / "report" / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    title = f"{times.name}, {RENDERER}, {times.threads} threads; mean of {len(clips)} clips of {data}"
    for metric in TRADED:
        save_figure(figures / f"trade-{metric}.png", draw_front(rows, metric, title))
    save_figure(figures / "trade-samples.png", draw_samples(samples.rows, title))
    content = {
        "schema": 1,
        "dataset": str(data),
        "device": device_in_words(),
        "versions": versions(DENOISING),
        "profile": budget,
        "clips": [f"{clip.scene}/{clip.name}" for clip in clips],
        "size": times.name,
        "threads": times.threads,
        "rows": [asdict(row) for row in rows],
        "samples": asdict(samples),
    }
    write_json(runs / "report" / "trade.json", content)
    return tables(rows, samples, title, times)


def tables(rows: Sequence[Trade], samples: SampleTrades, title: str, times: Times) -> str:
    """What `onespp trade` prints."""
    parts = [title, FRONTS]
    for signal in dict.fromkeys(row.signal for row in rows):
        parts.append(f"{signal} light\n{front_table([row for row in rows if row.signal == signal])}")
    if untimed := [row.label for row in rows if row.ms is None]:
        parts.append(f"Without a time: {', '.join(untimed)}. Measure them with `{times.command}`.")
    parts.append(f"samples a pixel\n{samples_table(samples.rows)}")
    if samples.shrinkage:
        words = "what shrinkage gains on the better of noise and denoiser, dB: mean of the clips (worst)"
        parts.append(f"{words}\n{gains_table(samples.shrinkage)}")
    parts.append(f"trained on 1 spp, fed more (after RAE, Fig. 9 and 11)\n{generalisation(samples.rows)}")
    return "\n\n".join(parts)
