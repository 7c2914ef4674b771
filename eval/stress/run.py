"""`onespp stress`: every denoiser in every stress case, and the requirements that it breaks."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from tabulate import tabulate
from tqdm import tqdm

from errors import BadInput
from eval.selection import cannot_run, choose, untrained, weights_file
from eval.stress.cases import LONG_CASE, RECOVERY_LIMIT, STRESS_CASES, StressCase
from eval.stress.check import FRESH, REQUIREMENTS, StressCheck, StressRow, last_layers
from files import write_file, write_json
from models.registry import DENOISERS, DenoiserName, create
from models.spec import DenoiserSpec, precisions_of
from plotting import Figure, plt, save_figure
from provenance import DENOISING, versions
from timing import thread_count


def stressed(names: Sequence[str], runs: Path, budget: str) -> list[DenoiserSpec]:
    """The named denoisers, or all that can run here, with trained weights if there are any, else random ones.

    Raises BadInput where a named one is unknown or cannot run, and for NAME@BUDGET without its weights.
    """
    specs = []
    obstacles = (cannot_run, lambda name: untrained(runs, budget, name) if name.budget else None)
    for name in choose(names, map(DenoiserName, DENOISERS), *obstacles):
        file = weights_file(name, runs, budget)
        specs.append(DenoiserSpec(name, weights=file if file and file.exists() else None))
    return specs


def weights_label(spec: DenoiserSpec) -> str | None:
    """The file of its weights, or FRESH; None for a denoiser that has none."""
    if spec.weights:
        return str(spec.weights)
    return FRESH if spec.facts.is_network else None


def applies(case: StressCase, spec: DenoiserSpec) -> bool:
    """Whether the denoiser computes in the case's precision, and has logits if the case scales them."""
    return case.precision in precisions_of(spec.denoiser) and (
        case.logits is None or bool(last_layers(create(spec.denoiser)))
    )


def cases_in(precision: str, long: bool) -> list[StressCase]:
    """All cases, with LONG_CASE if `long`; in half precision without those that compare precisions."""
    cases = [*STRESS_CASES, LONG_CASE] if long else [*STRESS_CASES]
    if precision == "float32":
        return cases
    return [replace(case, precision=precision) for case in cases if case.compare_with != "float32"]


@torch.no_grad()
def check_all(specs: Sequence[DenoiserSpec], cases: Sequence[StressCase]) -> list[StressRow]:
    """Run every denoiser in every case that applies to it, on one thread, for images are too small for more."""
    applying = {spec: [case for case in cases if applies(case, spec)] for spec in specs}
    rows = []
    with thread_count(1), tqdm(total=sum(map(len, applying.values())), desc="stress", leave=False) as progress:
        for spec, ours in applying.items():
            build = cache(lambda precision, spec=spec: replace(spec, precision=precision).build())
            for case in ours:
                progress.set_postfix_str(f"{spec.name}: {case.name}")
                rows.append(StressCheck(build, case).row(spec.name, weights_label(spec)))
                progress.update()
    return rows


def short(value: float | None) -> str:
    """A number with two digits."""
    if value is None:
        return "-"
    return "0" if value == 0 else f"{value:.1e}"


def recovery_time(row: StressRow, case: StressCase) -> str:
    """Frames until the effect of the case's bad pixel ends."""
    if case.only is None:
        return "-"
    return f"> {RECOVERY_LIMIT}" if row.recovery is None else str(row.recovery)


def error_table(rows: Sequence[StressRow], cases: Sequence[StressCase]) -> str:
    """One column per denoiser: its error in each case that applies, ! where it breaks a requirement, and a summary."""
    weights = {row.denoiser: row.weights for row in rows}
    by_case = {(row.denoiser, row.extreme): row for row in rows}
    errors = {key: short(row.error) + (" !" if row.broken else "") for key, row in by_case.items()}
    by_denoiser = {name: [row for row in rows if row.denoiser == name] for name in weights}

    cells = {None: "-", FRESH: FRESH}
    lines = [["weights", *(cells.get(file, "trained") for file in weights.values())]]
    lines += [[case.name, *(errors.get((name, case.name), "") for name in weights)] for case in cases]
    for case in cases:
        if case.only is not None:
            times = [recovery_time(by_case[name, case.name], case) for name in weights]
            lines.append([f"frames until recovery: {case.name}", *times])
    nonfinite = [sum(row.nonfinite for row in ours) for ours in by_denoiser.values()]
    lines.append(["pixels that are not finite", *map(str, nonfinite)])
    violations = [max(row.violation for row in ours) for ours in by_denoiser.values()]
    lines.append(["largest range violation", *map(short, violations)])
    return tabulate(lines, ["worst error", *weights], disable_numparse=True, maxheadercolwidths=11)


def details(rows: Sequence[StressRow], cases: Sequence[StressCase], form: str = "simple") -> str:
    """One line per row, with all values. `form` is one of tabulate's."""
    by_name = {case.name: case for case in cases}
    lines = [
        {
            "denoiser": row.denoiser,
            "weights": row.weights or "-",
            "extreme": row.extreme,
            "worst error": short(row.error),
            "non-finite": row.nonfinite,
            "range violation": short(row.violation),
            "recovery": recovery_time(row, by_name[row.extreme]),
            "broken": ", ".join(row.broken),
        }
        for row in rows
    ]
    return tabulate(lines, "keys", tablefmt=form, disable_numparse=True)


def verdict_text(rows: Sequence[StressRow], cases: Sequence[StressCase]) -> str:
    """The requirements that are broken, and where; or that all are kept."""
    broken = [row for row in rows if row.broken]
    if not broken:
        return "All requirements are kept."
    missed = {name for row in broken for name in row.broken}
    explained = [f"{name}: {text}" for name, text in REQUIREMENTS.items() if name in missed]
    return "\n".join(["Broken requirements:", "", details(broken, cases), "", *explained])


def heat_map(rows: Sequence[StressRow], cases: Sequence[StressCase]) -> Figure:
    """The largest errors, one row per denoiser and one column per case, with a cross where a requirement is broken."""
    names = list(dict.fromkeys(row.denoiser for row in rows))
    columns = [case.name for case in cases]
    errors = np.full((len(names), len(columns)), np.nan)
    figure, axes = plt.subplots(figsize=(3 + 0.45 * len(columns), 2.6 + 0.35 * len(names)), layout="constrained")
    for row in rows:
        y = names.index(row.denoiser)
        x = columns.index(row.extreme)
        errors[y, x] = np.nan if row.error is None else np.log10(max(row.error, 1e-8))
        if row.broken:
            axes.plot(x, y, "x", color="red", markersize=12, markeredgewidth=3)
    image = axes.imshow(errors, cmap="viridis", vmin=-8, vmax=2)
    axes.set_facecolor("lightgrey")  # where there is no error to show
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right")
    axes.set_yticks(range(len(names)), names)
    axes.set_title("Worst error at the extremes; red crosses: a requirement is broken")
    figure.colorbar(image, label="log₁₀ of the error over the brightest pixel")
    return figure


def stress(
    runs: Path, names: Sequence[str] = (), budget: str = "quick", long: bool = False, precision: str = "float32"
) -> bool:
    """Run the stress cases of the named denoisers, or of all that can run here; with 10 000 frames if `long`.

    Prints tables and writes RUNS/stress/results.json, table.md and errors.png. Returns whether all requirements are
    kept. Raises BadInput for an unknown denoiser, damaged weights, and where none computes in the precision.
    """
    specs = [spec for spec in stressed(names, runs, budget) if precision in precisions_of(spec.denoiser)]
    if not specs:
        raise BadInput(f"none of {', '.join(names)} computes in {precision}; name a network, or leave out --precision")
    cases = cases_in(precision, long)
    folder = runs / "stress"
    folder.mkdir(parents=True, exist_ok=True)
    rows = check_all(specs, cases)
    results = {
        "schema": 1,
        "device": "cpu, 1 thread",
        "versions": versions(DENOISING),
        "precision": precision,
        "rows": [asdict(row) for row in rows],
    }
    write_json(folder / "results.json", results)
    write_file(folder / "table.md", (details(rows, cases, "pipe") + "\n").encode())
    save_figure(folder / "errors.png", heat_map(rows, cases))
    print(error_table(rows, cases))
    print("\n" + verdict_text(rows, cases))
    return not any(row.broken for row in rows)
