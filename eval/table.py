"""Results for people: numbers as text, marked where the reference's own noise decides them."""

from collections.abc import Sequence

from tabulate import tabulate

from eval.floor import floor_limit, within_floor
from eval.metrics import METRICS
from eval.results import FLOOR, ClipResults, Values

PRINTED = ("rmse", "psnr", "ssim", "flip", "mse_unbiased", "temporal_error", "disocclusion_l1")
NEAR = "≈"
LEGEND = f"{NEAR} within the noise floor: as close to the truth as the reference itself, so the digits mean nothing"


def cell(metric: str, value: float | None, floor: float | None = None) -> str:
    """A number, marked if it is within its noise floor."""
    if value is None:
        return "-"
    mark = NEAR if within_floor(metric, value, floor) else ""
    return mark + METRICS[metric].form.format(value)


def compared(metric: str, value: float, floor: float | None) -> float:
    """What to compare by: the digits that are shown, and one and the same number for all that is within the floor."""
    if floor is not None and within_floor(metric, value, floor):
        value = floor_limit(metric, floor)
    return float(METRICS[metric].form.format(value))


def floor_cell(metric: str, value: float | None) -> str:
    """A noise floor; of the unbiased MSE the standard error."""
    return ("±" if metric == "mse_unbiased" and value is not None else "") + cell(metric, value)


def cells(values: Values, floors: Values) -> list[str]:
    return [cell(metric, values.get(metric), floors.get(metric)) for metric in PRINTED]


def table(clips: Sequence[ClipResults]) -> str:
    """A row a clip, signal and denoiser, and the reference's own noise floor below each signal."""
    lines = []
    for clip in clips:
        name, floors = f"{clip.scene}/{clip.clip}", clip.reference.metrics
        lines += [
            [name, track.denoiser, clip.signal, *cells(track.metrics, floors), track.nonfinite] for track in clip.tracks
        ]
        lines.append([name, FLOOR, clip.signal, *(floor_cell(metric, floors.get(metric)) for metric in PRINTED), ""])
    head = ["clip", "denoiser", "signal", *(METRICS[metric].title for metric in PRINTED), "non-finite"]
    text = tabulate(lines, head, disable_numparse=True)
    return f"{text}\n{LEGEND}" if NEAR in text else text
