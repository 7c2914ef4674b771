"""`onespp stress`: every denoiser in every stress case, and the requirements that it breaks."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path

import torch
from tqdm import tqdm

from errors import BadInput
from eval.selection import cannot_run, choose, untrained, weights_file
from eval.stress.cases import LONG_CASE, STRESS_CASES, StressCase
from eval.stress.check import FRESH, StressCheck, StressRow, last_layers
from eval.stress.tables import details, error_table, heat_map, verdict_text
from files import write_file, write_json
from models.denoiser import Denoiser
from models.registry import DENOISERS, DenoiserName, create
from models.spec import DenoiserSpec, precisions_of
from plotting import save_figure
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


def build_in(spec: DenoiserSpec, precision: str) -> Denoiser:
    return replace(spec, precision=precision).build()


@torch.no_grad()
def check_all(specs: Sequence[DenoiserSpec], cases: Sequence[StressCase]) -> list[StressRow]:
    """Run every denoiser in every case that applies to it, on one thread, for images are too small for more."""
    applying = {spec: [case for case in cases if applies(case, spec)] for spec in specs}
    rows = []
    with thread_count(1), tqdm(total=sum(map(len, applying.values())), desc="stress", leave=False) as progress:
        for spec, ours in applying.items():
            build = cache(partial(build_in, spec))
            for case in ours:
                progress.set_postfix_str(f"{spec.name}: {case.name}")
                rows.append(StressCheck(build, case).row(spec.name, weights_label(spec)))
                progress.update()
    return rows


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
