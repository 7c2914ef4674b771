"""Quality against samples a pixel: whether milliseconds are better spent on samples or on the filter."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from errors import BadInput
from eval.harness import entrant, evaluate_clip
from eval.means import compared_mean, joint_floor, means
from eval.metrics import METRICS, Values
from eval.results import REFERENCE
from eval.selection import with_indirect_baselines
from eval.spec import DenoiserSpec, precision_in_use
from eval.text_table import cell
from eval.tradeoff.clips import scene_of, source, with_samples
from eval.tradeoff.pareto import Point, dominators
from eval.tradeoff.sample_cost import Cost, sample_cost
from eval.tradeoff.times import Times
from render.clip import Options

LEVELS = (1, 2, 4, 8, 16, 32, 64, 128, 256)
SAMPLED = ("noisy", "accumulated", "svgf", "oidn", "rae", "wskp6", "ntd")
GENERALISED, FED = ("noisy", "accumulated", "svgf", "rae"), (1, 4, 256)  # RAE §5.4

Row = dict[str, Any]


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


def judge(
    chosen: Sequence[DenoiserSpec], clips: Sequence[Clip], dataset: Dataset, levels: Sequence[int], folder: Path
) -> dict[tuple[str, str, int], list[Values]]:
    """Metrics of (signal, label, samples a pixel), clip by clip. What is rendered and judged is kept in `folder`.

    Noise floors are those of the label REFERENCE.
    """
    entrants = [entrant(spec, spec.label) for spec in with_indirect_baselines(chosen)]
    found = dict[tuple[str, str, int], list[Values]]()
    jobs = [(clip, spp) for clip in clips for spp in levels]
    for clip, spp in tqdm(jobs, "samples a pixel", unit="clip"):
        fed = with_samples(clip, dataset, spp, source(clip, levels[-1]), folder / "data")
        for result in evaluate_clip(fed, entrants, folder):
            found.setdefault((result.signal, result.denoiser, spp), []).append(result.metrics)
    return found


def costs(clips: Sequence[Clip], dataset: Dataset, times: Times) -> dict[str, Cost]:
    """What samples of each clip's scene cost at the size and with the threads of the bench."""
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
) -> dict[str, Any]:
    """A row a signal, denoiser and number of samples, with what its frame costs and by whom it is beaten in PSNR."""
    quality = judge(chosen, clips, dataset, levels, folder)
    cost = costs(clips, dataset, times)
    by_label = {candidate.label: candidate for candidate in chosen}
    rows: list[Row] = []
    for (signal, label, spp), judged in quality.items():
        if label == REFERENCE:
            continue
        candidate, floors = by_label[label], quality[signal, REFERENCE, spp]
        render_ms, filter_ms = float(np.mean([c.of(spp) for c in cost.values()])), times.of(candidate, signal)
        total = None if filter_ms is None else render_ms + filter_ms
        rows.append(
            {
                "label": candidate.label,
                "denoiser": candidate.name,
                "dtype": candidate.precision,
                **{"signal": signal, "spp": spp, "render_ms": render_ms, "filter_ms": filter_ms, "ms": total},
                **{"metrics": means(judged), "floors": joint_floor(judged, floors)},
                "compared": {"psnr": compared_mean("psnr", judged, floors)},
            }
        )
    for signal in {row["signal"] for row in rows}:
        mark_beaten([row for row in rows if row["signal"] == signal])
    return {
        "levels": [*levels],
        "sources": {f"{clip.scene}/{clip.name}": source(clip, levels[-1]) for clip in clips},
        "render_ms": {name: c._asdict() for name, c in cost.items()},
        "rows": rows,
    }


def shown(row: Mapping[str, Any], metric: str) -> str:
    return cell(metric, row["metrics"][metric], row["floors"].get(metric))


def name_of(row: Mapping[str, Any]) -> str:
    return f"{row['label']}, {row['spp']} spp"


def mark_beaten(rows: Sequence[Row]) -> None:
    """Say of each row which one has the higher PSNR in no more milliseconds; None on the front."""
    points = {name_of(row): Point(row["ms"], row["compared"]["psnr"]) for row in rows if row["ms"] is not None}
    beaten = dominators(points, more_is_better=True)
    for row in rows:
        row["dominated_by"] = beaten.get(name_of(row))


def samples_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """PSNR of each denoiser at each number of samples, and below what is on the front of PSNR and milliseconds."""
    groups: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        line = groups.setdefault((row["signal"], row["label"]), {"signal": row["signal"], "denoiser": row["label"]})
        line[f"{row['spp']} spp"] = shown(row, "psnr")
    text = f"PSNR dB\n{tabulate([*groups.values()], 'keys', disable_numparse=True)}"
    for signal in dict.fromkeys(row["signal"] for row in rows):
        front = [r for r in rows if (r["signal"], r["dominated_by"]) == (signal, None) and r["ms"] is not None]
        front.sort(key=lambda row: row["ms"])
        steps = (f"{name_of(row)} ({row['ms']:.4g} ms, {shown(row, 'psnr')} dB)" for row in front)
        text += f"\n\nWorth the time, {signal} light: {'; '.join(steps)}"
    return text


def generalisation(rows: Sequence[Mapping[str, Any]]) -> str:
    """What RAE, trained on 1 spp, makes of more, beside filters that are not trained."""
    ours = [r for r in rows if r["signal"] == "total" and r["denoiser"] in GENERALISED and r["spp"] in FED]
    metrics = ("psnr", "ssim", "rmse")
    lines = [
        [row["label"], row["spp"], *(shown(row, metric) for metric in metrics)]
        for row in sorted(ours, key=lambda row: (row["spp"], GENERALISED.index(row["denoiser"])))
    ]
    return tabulate(lines, ["denoiser", "spp", *(METRICS[m].title for m in metrics)], disable_numparse=True)
