"""`onespp export`: a trained denoiser as one file, with golden frames of a synthetic sequence."""

from dataclasses import replace
from pathlib import Path
from typing import Literal

from eval.bench.synthetic_frames import synthetic_frame
from eval.selection import weights_of
from models.export.package import Export, check_exportable, write_export
from models.export.program import Format, check_installed
from models.export.step import Warp
from models.registry import parse_name

GOLDEN_SIZE = (72, 104)  # height and width in pixels, neither a multiple of 16
GOLDEN_FRAMES = 4


def export(
    name: str,
    to: Format,
    runs: Path,
    weights: Path | None = None,
    precision: Literal["float32", "float16"] = "float32",
    warp: Warp = "inside",
    out: Path | None = None,
) -> str:
    """Write the export to `out`, by default RUNS/export/NAME-TO. Returns a summary.

    `weights` are by default the shipped ones, for NAME@BUDGET those in RUNS. Raises BadInput where the denoiser cannot
    be exported or has no weights, and where packages are missing.
    """
    parsed = parse_name(name)
    denoiser = str(replace(parsed, budget=None))
    check_exportable(denoiser)
    check_installed(to)
    weights = weights or weights_of(parsed, runs)
    assert weights is not None
    folder = out or runs / "export" / f"{name}-{to}"
    frames = [synthetic_frame(index, *GOLDEN_SIZE) for index in range(GOLDEN_FRAMES)]
    written = write_export(Export(denoiser, weights, to, precision, warp), frames, folder)
    difference = written["largest_difference"]["from_onespp"]
    return (
        f"{folder / written['file']}: {written['operators']['total']} operators; differs from onespp by at most "
        f"{difference:.1e} over {GOLDEN_FRAMES} frames"
    )
