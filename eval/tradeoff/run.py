"""`onespp trade`: what quality costs in milliseconds, by denoiser, precision, size of network and samples a pixel."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tabulate import tabulate

from datasets.clip import Dataset
from eval.bench.sizes import parse_size
from eval.harness import clips_of_one_spp, entrant, evaluate_clip
from eval.means import compared_mean, joint_floor, means
from eval.metrics import METRICS, Values
from eval.results import REFERENCE, Result
from eval.selection import with_indirect_baselines
from eval.spec import DenoiserSpec
from eval.text_table import LEGEND, NEAR, cell
from eval.tradeoff.candidates import candidates, trained_epochs
from eval.tradeoff.pareto import Point, dominators
from eval.tradeoff.plots import draw_front, draw_samples
from eval.tradeoff.sample_cost import RENDERER
from eval.tradeoff.samples import LEVELS, by_samples, check_levels, generalisation, sampled, samples_table
from eval.tradeoff.times import Times
from files import write_json
from plotting import save_figure
from provenance import DENOISING, device_in_words, versions

TRADED = ("psnr", "ssim", "rmse")
FRONTS = (
    "On fronts a clip within its noise floor counts as at its edge: so a mean can be beaten by one that looks worse."
)

Found = dict[tuple[str, str], list[Values]]  # of (signal, label), clip by clip; of the reference the noise floors


def by_label(results: Sequence[Result]) -> Found:
    found: Found = {}
    for result in results:
        found.setdefault((result.signal, result.denoiser), []).append(result.metrics)
    return found


def rows_of(chosen: Sequence[DenoiserSpec], quality: Found, times: Times) -> list[dict[str, Any]]:
    """A row a candidate and signal: milliseconds, metrics, and by whom it is beaten in each metric."""
    candidates_by_label = {candidate.label: candidate for candidate in chosen}
    rows: list[dict[str, Any]] = []
    for (signal, label), clips in quality.items():
        if label in candidates_by_label:
            candidate, floors = candidates_by_label[label], quality[signal, REFERENCE]
            rows.append(
                {
                    "label": candidate.label,
                    "denoiser": candidate.name,
                    "dtype": candidate.precision,
                    **{"signal": signal, "epochs": trained_epochs(candidate), "ms": times.of(candidate, signal)},
                    **{"metrics": means(clips), "floors": joint_floor(clips, floors)},
                    "compared": {metric: compared_mean(metric, clips, floors) for metric in TRADED},
                }
            )
    for signal in {row["signal"] for row in rows}:
        ours = [row for row in rows if row["signal"] == signal]
        beaten = {metric: beaten_by(ours, metric) for metric in TRADED}
        for row in ours:
            row["dominated_by"] = {metric: by.get(row["label"]) for metric, by in beaten.items()}
    return rows


def beaten_by(rows: Sequence[Mapping[str, Any]], metric: str) -> dict[str, str | None]:
    """For each label that has a time and a value: the best that is no slower and better, None on the front."""
    points = {
        row["label"]: Point(row["ms"], row["compared"][metric])
        for row in rows
        if row["ms"] is not None and row["compared"][metric] is not None
    }
    return dominators(points, METRICS[metric].more_is_better)


def front_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Fastest first. Who is on the front of a metric is marked so, who is not is told by whom it is beaten."""

    def standing(row: Mapping[str, Any], metric: str) -> str:
        if row["ms"] is None or row["metrics"][metric] is None:
            return "-"
        return row["dominated_by"][metric] or "front"

    lines = []
    for row in sorted(rows, key=lambda row: (row["ms"] is None, row["ms"])):
        lines.append(
            {
                **{"denoiser": row["denoiser"], "dtype": row["dtype"], "epochs": row["epochs"] or "-"},
                "ms": "-" if row["ms"] is None else f"{row['ms']:.4g}",
                **{METRICS[m].title: cell(m, row["metrics"][m], row["floors"].get(m)) for m in TRADED},
                **{f"beaten in {METRICS[m].title.split()[0]} by": standing(row, m) for m in TRADED},
            }
        )
    text = tabulate(lines, "keys", disable_numparse=True)
    return f"{text}\n{LEGEND}" if NEAR in text else text


def trade(
    data: Path,
    runs: Path,
    profile: str,
    names: Sequence[str] = (),
    size: str = "1280x720",
    threads: int | None = None,
    levels: Sequence[int] = LEVELS,
) -> str:
    """Judge all that can be traded on the test clips: tables, RUNS/report/trade.json and figures beside it.

    Times are those of RUNS/bench at `size` and `threads`. What was judged or rendered before is kept in RUNS/trade.
    Raises BadInput where there are no times or clips, for a bad size or numbers of samples, and as `candidates` does.
    """
    check_levels(levels)
    dataset, times = Dataset(data), Times(runs, parse_size(size), threads, RENDERER)
    clips = clips_of_one_spp(dataset)
    chosen = candidates(names, runs, profile)

    entrants = [entrant(spec, spec.label) for spec in with_indirect_baselines(chosen)]
    results = [result for clip in clips for result in evaluate_clip(clip, entrants, runs / "trade")]
    rows = rows_of(chosen, by_label(results), times)
    few = sampled(chosen, bool(names))
    samples = by_samples(few, clips, dataset, levels, times, runs / "trade")

    figures = runs / "report" / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    title = f"{times.name}, {RENDERER}, {times.threads} threads; mean of {len(clips)} clips of {data}"
    for metric in TRADED:
        save_figure(figures / f"trade-{metric}.png", draw_front(rows, metric, title))
    save_figure(figures / "trade-samples.png", draw_samples(samples["rows"], title))
    facts = {
        "schema": 1,
        "dataset": str(data),
        "device": device_in_words(),
        "versions": versions(DENOISING),
        "profile": profile,
    }
    facts |= {"clips": [f"{clip.scene}/{clip.name}" for clip in clips], "size": times.name, "threads": times.threads}
    write_json(runs / "report" / "trade.json", facts | {"rows": rows, "samples": samples})
    return tables(rows, samples, title, times)


def tables(rows: Sequence[Mapping[str, Any]], samples: Mapping[str, Any], title: str, times: Times) -> str:
    parts = [title, FRONTS]
    for signal in dict.fromkeys(row["signal"] for row in rows):
        parts.append(f"{signal} light\n{front_table([row for row in rows if row['signal'] == signal])}")
    if untimed := [row["label"] for row in rows if row["ms"] is None]:
        parts.append(f"Without a time: {', '.join(untimed)}. Measure them with `{times.command}`.")
    parts.append(f"samples a pixel\n{samples_table(samples['rows'])}")
    parts.append(f"trained on 1 spp, fed more (after RAE, Fig. 9 and 11)\n{generalisation(samples['rows'])}")
    return "\n\n".join(parts)
