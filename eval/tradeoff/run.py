"""`onespp trade`: quality against milliseconds, by denoiser, precision and samples per pixel."""

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
from eval.tradeoff.samples import samples_table
from eval.tradeoff.shrinkage import gains_table
from eval.tradeoff.times import Times
from files import write_json
from plotting import save_figure
from provenance import DENOISING, device_in_words, versions

FRONTS = "Fronts count a clip within its noise floor as at the floor's edge: a worse mean can dominate a better one."


def trade(
    data: Path,
    runs: Path,
    budget: str,
    names: Sequence[str] = (),
    size: str = "1280x720",
    threads: int | None = None,
    levels: Sequence[int] = SPP_LEVELS,
) -> str:
    """Evaluate all candidates on the test clips. Returns tables, writes RUNS/report/trade.json and figures.

    Times are those of RUNS/bench at `size` and `threads`. Clips and results are stored in RUNS/trade and reused.
    Raises BadInput where there are no times or clips, for a bad size or numbers of samples, and as `candidates`.
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
    """The output of `onespp trade`."""
    parts = [title, FRONTS]
    for signal in dict.fromkeys(row.signal for row in rows):
        parts.append(f"{signal} light\n{front_table([row for row in rows if row.signal == signal])}")
    if untimed := [row.label for row in rows if row.ms is None]:
        parts.append(f"Without a time: {', '.join(untimed)}. Measure them with `{times.command} --all`.")
    parts.append(f"samples per pixel\n{samples_table(samples.rows)}")
    if samples.shrinkage:
        heading = "gain of shrinkage over the better of noisy frame and denoiser, dB: mean of the clips (worst)"
        parts.append(f"{heading}\n{gains_table(samples.shrinkage)}")
    return "\n\n".join(parts)
