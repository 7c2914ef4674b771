"""`onespp bench scaling`: milliseconds against pixels, each denoiser in the precision in which it is used here."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from tabulate import tabulate

from eval.bench.race import Timing, race
from eval.bench.sizes import parse_size, size_name, thread_counts
from eval.extra_denoisers import FAST_OIDN
from eval.selection import choose, unavailable
from eval.spec import DenoiserSpec, precision_in_use
from files import write_json
from models.registry import DENOISERS
from plotting import DPI, plt, save_figure
from provenance import device_in_words
from timing import thread_count

SIZES = ("320x180", "480x270", "640x360", "960x540", "1280x720", "1920x1080")


def in_use(names: Sequence[str]) -> list[DenoiserSpec]:
    """The named denoisers and OIDN, or all that can run here, as evaluation runs them, with fresh weights.

    Raises BadInput where a named one is unknown or cannot run.
    """
    baselines = [] if unavailable("oidn") else ["oidn", FAST_OIDN]
    chosen = choose([*names, *baselines] if names else [], (*DENOISERS, FAST_OIDN), unavailable)
    return [DenoiserSpec(name, precision=precision_in_use(name)) for name in chosen]


def exponent(pixels: Sequence[int], ms: Sequence[float]) -> float | None:
    """k of ms ~ pixels^k, by least squares of logarithms; None for fewer than two sizes."""
    return float(np.polyfit(np.log(pixels), np.log(ms), 1)[0]) if len(set(pixels)) > 1 else None


def by_denoiser(rows: Sequence[Timing]) -> dict[str, list[Timing]]:
    return {row.denoiser: [other for other in rows if other.denoiser == row.denoiser] for row in rows}


def draw(rows: Sequence[Timing]) -> Figure:
    """Median milliseconds against pixels, both logarithmic, and how far they spread (p10 to p90)."""
    figure, axis = plt.subplots(figsize=(8, 5.5), dpi=DPI, layout="constrained")
    for index, (name, ours) in enumerate(by_denoiser(rows).items()):
        pixels = [row.width * row.height for row in ours]
        ms, low, high = (np.array([getattr(row, key) for row in ours]) for key in ("ms_median", "ms_p10", "ms_p90"))
        style = ("-", "--", ":")[index // 10 % 3]  # ten colours
        axis.errorbar(pixels, ms, (ms - low, high - ms), fmt="o", ls=style, ms=3, lw=1.2, capsize=2, label=name)
    axis.set(xlabel="pixels", ylabel="ms a frame", xscale="log", yscale="log")
    axis.set_title(f"{rows[0].threads} threads", fontsize=9)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=7, ncols=2)
    return figure


def table(rows: Sequence[Timing]) -> str:
    """A row a denoiser: milliseconds at each size, and the exponent."""
    lines = []
    for name, ours in by_denoiser(rows).items():
        ms = {size_name((row.height, row.width)): row.ms_median for row in ours}
        k = exponent([row.width * row.height for row in ours], list(ms.values()))
        lines.append({"denoiser": name, "dtype": ours[0].dtype} | ms | {"ms ~ pixels^": k})
    return tabulate(lines, "keys", floatfmt=".3g", missingval="-")


def bench_scaling(runs: Path, names: Sequence[str], sizes: Sequence[str] = (), threads: Sequence[int] = ()) -> str:
    """Time the denoisers on the CPU at rising sizes: a table, RUNS/bench/scaling.json and a plot for the report.

    With the largest number of `threads`, by default all. Raises BadInput for unknown names, sizes, numbers of threads.
    """
    pixels = sorted({parse_size(size) for size in sizes or SIZES}, key=lambda size: size[0] * size[1])
    specs = in_use(names)
    count = thread_counts(threads)[-1]
    rows: list[Timing] = []
    with thread_count(count):
        for size in pixels:
            rows += [contender.timing(size) for contender in race(specs, size)]
    (runs / "bench").mkdir(parents=True, exist_ok=True)
    figures = runs / "report" / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    write_json(
        runs / "bench" / "scaling.json",
        {
            "schema": 1,
            "device": device_in_words(threads=count),
            "threads": count,
            "rows": [asdict(row) for row in rows],
        },
    )
    save_figure(figures / "scaling.png", draw(rows))
    return table(rows)
