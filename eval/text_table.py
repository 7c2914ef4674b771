"""Results for people: numbers as text, marked where the reference's own noise decides them."""

from collections.abc import Sequence

from tabulate import tabulate

from eval.metrics import METRICS, Values, within_floor
from eval.results import FLOOR, ClipResults

PRINTED = ("rmse", "psnr", "ssim", "flip", "mse_unbiased", "temporal_error", "disocclusion_l1")
NEAR = "≈"
LEGEND = f"{NEAR} within the noise floor: as close to the truth as the reference itself, so the digits mean nothing"


def cell(metric: str, value: float | None, floor: float | None = None) -> str:
    """A number, marked if it is within its noise floor."""
    if value is None:
        return "-"
    mark = NEAR if within_floor(metric, value, floor) else ""
    return mark + METRICS[metric].form.format(value)


def floor_cell(metric: str, value: float | None) -> str:
    """A noise floor, or the standard error of what has none."""
    return ("±" if METRICS[metric].floor_is_error and value is not None else "") + cell(metric, value)


def cells(values: Values, floors: Values) -> list[str]:
    return [cell(metric, values.get(metric), floors.get(metric)) for metric in PRINTED]


def table(clips: Sequence[ClipResults]) -> str:
    """A row a clip, signal and denoiser, and the reference's own noise floor below each signal."""
    lines = []
    for clip in clips:
        name, floors = f"{clip.scene}/{clip.clip}", clip.reference.metrics
        lines += [
            [name, result.denoiser, clip.signal, *cells(result.metrics, floors), result.nonfinite]
            for result in clip.results
        ]
        lines.append([name, FLOOR, clip.signal, *(floor_cell(metric, floors.get(metric)) for metric in PRINTED), ""])
    head = ["clip", "denoiser", "signal", *(METRICS[metric].title for metric in PRINTED), "non-finite"]
    text = tabulate(lines, head, disable_numparse=True)
    return f"{text}\n{LEGEND}" if NEAR in text else text
