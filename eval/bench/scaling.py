"""`onespp bench scaling`: milliseconds against pixels, each denoiser in the precision in which it is used here."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from tabulate import tabulate

from eval.bench.denoisers import ways
from eval.bench.output import bench_folder
from eval.bench.race import TIMED_FRAMES, Timing, race
from eval.bench.sizes import parse_size, size_name, threads_or_all
from eval.extra_denoisers import WINDOW_SETS
from eval.spec import DenoiserSpec, precision_in_use
from files import write_json
from plotting import DPI, plt, save_figure
from provenance import device_in_words
from timing import thread_count

SCALING_SIZES = ("320x180", "480x270", "640x360", "960x540", "1280x720", "1920x1080")


def in_use(names: Sequence[str]) -> list[DenoiserSpec]:
    """Of all ways to run the named denoisers and OIDN, or all that can run here, those that evaluation takes.

    Without names they are those of the registry: no networks of other sizes. Raises BadInput where a named one is
    unknown or cannot run.
    """
    return [
        spec
        for spec in ways(names)
        if spec.compiled
        and spec.signal is None
        and spec.precision == precision_in_use(spec.name)
        and (names or spec.name not in WINDOW_SETS)
    ]


def exponent(pixels: Sequence[int], ms: Sequence[float]) -> float | None:
    """k of ms ~ pixels^k, by least squares of the logarithms; None for fewer than two sizes."""
    return float(np.polyfit(np.log(pixels), np.log(ms), 1)[0]) if len(set(pixels)) > 1 else None


def by_denoiser(rows: Sequence[Timing]) -> dict[str, list[Timing]]:
    groups: dict[str, list[Timing]] = {}
    for row in rows:
        groups.setdefault(row.denoiser, []).append(row)
    return groups


def scaling_figure(rows: Sequence[Timing]) -> Figure:
    """Median milliseconds against pixels, both logarithmic, and how far they spread (p10 to p90)."""
    figure, axis = plt.subplots(figsize=(8, 5.5), dpi=DPI, layout="constrained")
    for index, (name, ours) in enumerate(by_denoiser(rows).items()):
        pixels = [row.width * row.height for row in ours]
        ms = np.array([row.ms_median for row in ours])
        below = ms - [row.ms_p10 for row in ours]
        above = [row.ms_p90 for row in ours] - ms
        style = ("-", "--", ":")[index // 10 % 3]  # ten colours
        axis.errorbar(pixels, ms, (below, above), fmt="o", ls=style, ms=3, lw=1.2, capsize=2, label=name)
    axis.set(xlabel="pixels", ylabel="ms a frame", xscale="log", yscale="log")
    axis.set_title(f"{rows[0].threads} threads", fontsize=9)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=7, ncols=2)
    return figure


def table_line(name: str, rows: Sequence[Timing]) -> dict[str, Any]:
    """A denoiser's milliseconds at each size, and the exponent."""
    ms = {size_name((row.height, row.width)): row.ms_median for row in rows}
    law = exponent([row.width * row.height for row in rows], [row.ms_median for row in rows])
    return {"denoiser": name, "dtype": rows[0].dtype, **ms, "ms ~ pixels^": law}


def bench_scaling(
    runs: Path,
    names: Sequence[str] = (),
    sizes: Sequence[str] = (),
    threads: int | None = None,
    measured: int = TIMED_FRAMES,
) -> str:
    """Time the denoisers on the CPU at rising sizes: a table, RUNS/bench/scaling.json and a plot for the report.

    At SCALING_SIZES and with as many threads as PyTorch takes, unless others are given. Raises BadInput for unknown
    names, sizes and numbers of threads.
    """
    pixels = sorted({parse_size(size) for size in sizes or SCALING_SIZES}, key=lambda size: size[0] * size[1])
    specs = in_use(names)
    count = threads_or_all(threads)
    rows: list[Timing] = []
    with thread_count(count):
        for size in pixels:
            rows += [contender.timing(size) for contender in race(specs, size, measured)]
    content = {
        "schema": 1,
        "device": device_in_words(threads=count),
        "threads": count,
        "rows": [asdict(row) for row in rows],
    }
    write_json(bench_folder(runs) / "scaling.json", content)
    figures = runs / "report" / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    save_figure(figures / "scaling.png", scaling_figure(rows))
    lines = [table_line(name, ours) for name, ours in by_denoiser(rows).items()]
    return tabulate(lines, "keys", floatfmt=".3g", missingval="-")
