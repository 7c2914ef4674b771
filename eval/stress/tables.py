"""Tables and a picture of stress results."""

from collections.abc import Sequence

import numpy as np
from tabulate import tabulate

from eval.stress.cases import RECOVERY_LIMIT, StressCase
from eval.stress.check import FRESH, REQUIREMENTS, StressRow
from plotting import Figure, plt


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


def error_cell(row: StressRow | None) -> str:
    """The largest error, with a ! where a requirement is broken; empty where the case does not apply."""
    if row is None:
        return ""
    return short(row.error) + (" !" if row.broken else "")


def error_table(rows: Sequence[StressRow], cases: Sequence[StressCase]) -> str:
    """One column per denoiser: its error in each case, and a summary of the rest."""
    weights = {row.denoiser: row.weights for row in rows}
    by_case = {(row.denoiser, row.extreme): row for row in rows}
    by_denoiser = {name: [row for row in rows if row.denoiser == name] for name in weights}

    cells = {None: "-", FRESH: FRESH}
    lines = [["weights", *(cells.get(file, "trained") for file in weights.values())]]
    lines += [[case.name, *(error_cell(by_case.get((name, case.name))) for name in weights)] for case in cases]
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
