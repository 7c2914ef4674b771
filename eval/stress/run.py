"""`onespp stress`: every denoiser at every extreme, and whether it keeps what is required there."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tabulate import tabulate
from tqdm import tqdm

from errors import BadInput
from eval.spec import PRECISIONS
from eval.stress.cases import EXTREMES, LONG, RECOVERY_LIMIT, Extreme
from eval.stress.check import REQUIREMENTS, Outcome, Trial, heads
from files import write_file, write_json
from models.denoiser import Denoiser
from models.registry import DENOISERS, create, load, unavailable, without_taa
from plotting import plt, save_figure
from timing import thread_count
from train.task import WEIGHTS_FILE, run_folder

FRESH = "fresh"


@dataclass(frozen=True)
class Contestant:
    """A denoiser by name, with the file of its weights; None where it has none, or fresh ones."""

    name: str
    weights: Path | None

    @property
    def origin(self) -> str | None:
        """Of its weights: their file, or FRESH; None for a denoiser that has none."""
        return str(self.weights) if self.weights else FRESH if create(self.name).parameter_count() else None

    def build(self, precision: torch.dtype) -> Denoiser:
        """Ready to use. Fresh weights are always the same."""
        if self.weights:
            return load(self.name, self.weights, precision)
        torch.manual_seed(0)
        denoiser = create(self.name)
        denoiser.prepare(precision)
        return denoiser

    def takes(self, extreme: Extreme) -> bool:
        """Whether it computes in the precision, and has logits where these are to be scaled."""
        denoiser = create(self.name)
        return extreme.precision not in denoiser.refuses and (extreme.logits is None or bool(heads(denoiser)))


def contestants(names: Sequence[str], runs: Path, profile: str) -> list[Contestant]:
    """The named denoisers, or else all that can run here. Raises BadInput where a named one is unknown or cannot."""
    found = []
    for name in dict.fromkeys(names or DENOISERS):
        if reason := unavailable(name):
            if names:
                raise BadInput(reason)
            print(f"{name}: skipped, {reason}")
            continue
        file = run_folder(runs, without_taa(name), profile) / WEIGHTS_FILE
        found.append(Contestant(name, file if create(name).parameter_count() and file.exists() else None))
    return found


@dataclass(frozen=True)
class Row:
    """A row of results.json, which holds the outcome's attributes beside these."""

    denoiser: str
    weights: str | None
    extreme: str
    outcome: Outcome

    def as_json(self) -> dict[str, Any]:
        return {"denoiser": self.denoiser, "weights": self.weights, "extreme": self.extreme, **asdict(self.outcome)}


@torch.no_grad()
def measure(entrants: Sequence[Contestant], extremes: Sequence[Extreme]) -> list[Row]:
    """Every entrant at every extreme that it takes. One thread: on images this small others would only wait."""
    taken = {entrant: [extreme for extreme in extremes if entrant.takes(extreme)] for entrant in entrants}
    rows = []
    with thread_count(1), tqdm(total=sum(map(len, taken.values())), desc="stress", leave=False) as progress:
        for entrant, ours in taken.items():
            build = cache(entrant.build)
            for extreme in ours:
                progress.set_postfix_str(f"{entrant.name}: {extreme.name}")
                outcome = Trial(entrant.name, build, extreme).outcome()
                rows.append(Row(entrant.name, entrant.origin, extreme.name, outcome))
                progress.update()
    return rows


def number(value: float | None) -> str:
    return "-" if value is None else "0" if value == 0 else f"{value:.1e}"


def frames_of(row: Row, extreme: Extreme) -> str:
    """The recovery time for people."""
    if extreme.only is None:
        return "-"
    return f"> {RECOVERY_LIMIT}" if row.outcome.recovery is None else str(row.outcome.recovery)


def overview(rows: Sequence[Row], extremes: Sequence[Extreme]) -> str:
    """Errors of all denoisers at all extremes with a ! where a requirement is broken, and the rest in few lines."""
    found = {(row.denoiser, row.extreme): row for row in rows}
    names = {row.denoiser: row.weights for row in rows}
    of = {name: [row.outcome for row in rows if row.denoiser == name] for name in names}

    def line(extreme: Extreme) -> list[str]:
        cells = [found.get((name, extreme.name)) for name in names]
        return [f"{number(row.outcome.error)}{' !' * bool(row.outcome.broken)}" if row else "" for row in cells]

    def recovery(extreme: Extreme) -> list[str]:
        return [frames_of(found[name, extreme.name], extreme) for name in names]

    lines = [["weights", *("-" if w is None else w if w == FRESH else "trained" for w in names.values())]]
    lines += [[extreme.name, *line(extreme)] for extreme in extremes]
    lines += [[f"frames until forgotten: {e.name}", *recovery(e)] for e in extremes if e.only is not None]
    lines.append(["pixels that are not finite", *(str(sum(o.nonfinite for o in of[name])) for name in names)])
    lines.append(["largest range violation", *(number(max(o.violation for o in of[name])) for name in names)])
    return tabulate(lines, ["worst error", *names], disable_numparse=True, maxheadercolwidths=11)


def details(rows: Sequence[Row], extremes: Sequence[Extreme], form: str = "simple") -> str:
    """A line a row, with all that was measured."""
    by_name = {extreme.name: extreme for extreme in extremes}
    lines = [
        [
            *(row.denoiser, row.weights or "-", row.extreme, number(row.outcome.error), row.outcome.nonfinite),
            *(number(row.outcome.violation), frames_of(row, by_name[row.extreme]), ", ".join(row.outcome.broken)),
        ]
        for row in rows
    ]
    head = ["denoiser", "weights", "extreme", "worst error", "non-finite", "range violation", "recovery", "broken"]
    return tabulate(lines, head, tablefmt=form, disable_numparse=True)


def heat_map(rows: Sequence[Row], extremes: Sequence[Extreme], path: Path) -> None:
    """A PNG of the worst errors, a row a denoiser and a column an extreme, with a cross where one is broken."""
    names, columns = list(dict.fromkeys(row.denoiser for row in rows)), [extreme.name for extreme in extremes]
    errors = np.full((len(names), len(columns)), np.nan)
    figure, axes = plt.subplots(figsize=(3 + 0.45 * len(columns), 2.6 + 0.35 * len(names)), layout="constrained")
    for row in rows:
        place = names.index(row.denoiser), columns.index(row.extreme)
        errors[place] = np.nan if row.outcome.error is None else np.log10(max(row.outcome.error, 1e-8))
        if row.outcome.broken:
            axes.plot(*place[::-1], "x", color="red", markersize=12, markeredgewidth=3)
    image = axes.imshow(errors, cmap="viridis", vmin=-8, vmax=2)
    axes.set_facecolor("lightgrey")  # where there is no error to show
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right")
    axes.set_yticks(range(len(names)), names)
    axes.set_title("Worst error at the extremes; red crosses: a requirement is broken")
    figure.colorbar(image, label="log₁₀ of the error over the brightest pixel")
    save_figure(path, figure)


def stress(
    runs: Path, names: Sequence[str] = (), profile: str = "quick", long: bool = False, precision: str = "float32"
) -> bool:
    """Put the named denoisers, or all that can run here, to the extremes; 10 000 frames as well if `long`.

    Prints tables and writes RUNS/stress/results.json, table.md and errors.png. Returns whether all requirements are
    kept. Raises BadInput for an unknown denoiser, damaged weights, and where none takes the precision.
    """
    dtype = PRECISIONS[precision]
    entrants = [c for c in contestants(names, runs, profile) if dtype not in create(c.name).refuses]
    if not entrants:
        raise BadInput(f"none of {', '.join(names)} computes in {precision}; name a network, or leave out --precision")
    extremes = [*EXTREMES, *([LONG] if long else [])]
    if dtype != torch.float32:
        extremes = [replace(extreme, precision=dtype) for extreme in extremes if extreme.held_to != "float32"]
    folder = runs / "stress"
    folder.mkdir(parents=True, exist_ok=True)
    rows = measure(entrants, extremes)
    results = {
        "schema": 1,
        "device": "cpu, 1 thread",
        "versions": {package: version(package) for package in ("onespp", "torch")},
        "precision": precision,
        "rows": [row.as_json() for row in rows],
    }
    write_json(folder / "results.json", results)
    write_file(folder / "table.md", (details(rows, extremes, "pipe") + "\n").encode())
    heat_map(rows, extremes, folder / "errors.png")
    print(overview(rows, extremes))
    return report_broken([row for row in rows if row.outcome.broken], extremes)


def report_broken(broken: Sequence[Row], extremes: Sequence[Extreme]) -> bool:
    """Print which requirements are broken, where. Returns whether none is."""
    if not broken:
        print("\nAll requirements are kept.")
        return True
    missed = {name for row in broken for name in row.outcome.broken}
    print("\nBroken requirements:\n")
    print(details(broken, extremes))
    print("\n" + "\n".join(f"{name}: {text}" for name, text in REQUIREMENTS.items() if name in missed))
    return False
