"""`onespp bench rendering`: what references cost, next to stock Mitsuba."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tabulate import tabulate
from tqdm import tqdm

from datasets.tonemap import clip_exposure, display, luminance, psnr
from eval.bench.time_to_floor import FRAME, OURS, SIZE, Row, seconds_to_floor
from files import write_json
from render.backend import VARIANT

SCENES = ("cornell_box", "cornell_box_moving", *(f"room-{number}" for number in range(6)))
TARGET = 40.0  # dB


def display_of(radiance: NDArray[np.floating]) -> Callable[[NDArray[np.floating]], NDArray[np.float64]]:
    exposure = clip_exposure(luminance(radiance))
    return lambda image: display(image.astype(np.float64), exposure)


def with_ratios(rows: Iterator[Row]) -> Iterator[dict[str, Any]]:
    """The rows as dictionaries; ours, which follow stock Mitsuba's, with the share of its time that they take."""
    baseline = 1.0
    for row in rows:
        if row.renderer != OURS:
            baseline = row.seconds
        fields = row._asdict() | {"floor": psnr(row.floor)}
        yield fields | {"ratio": row.seconds / baseline if row.renderer == OURS else 1.0}


def bench_rendering(runs: Path) -> str:
    """Samples a second and seconds to 40 dB on a frame of each scene: a table, and RUNS/bench/rendering.json."""
    rows = seconds_to_floor(tqdm(SCENES, "scenes", leave=False), 10 ** (-TARGET / 10), display_of)
    table = list(with_ratios(rows))
    folder = runs / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    facts = {"variant": VARIANT, "size": SIZE, "frame": FRAME, "target_db": TARGET}
    write_json(folder / "rendering.json", {**facts, "rows": table})
    heads = {"samples_per_second": "samples/s", "floor": "floor dB", "seconds": f"seconds to {TARGET:.0f} dB"}
    return tabulate(table, heads, floatfmt=("", "", ".0f", ".2e", ".1f", ".2f", "", ".3f"))
