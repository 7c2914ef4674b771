"""Results as text; values within their noise floor are marked."""

from collections.abc import Sequence

from tabulate import tabulate

from eval.means import AGES, means_by_age
from eval.metrics import METRICS, within_floor
from eval.results import FLOOR, ClipResults, by_signal

PRINTED = ("rmse", "psnr", "ssim", "flip", "mse_unbiased", "temporal_error", "disocclusion_l1")
NEAR_FLOOR = "≈"
LEGEND = f"{NEAR_FLOOR} within the noise floor: as close to the truth as the reference; differences are not significant"


def value_cell(metric: str, value: float | None, floor: float | None = None) -> str:
    """A number, marked if it is within its noise floor."""
    if value is None:
        return "-"
    mark = NEAR_FLOOR if within_floor(metric, value, floor) else ""
    return mark + METRICS[metric].form.format(value)


def floor_cell(metric: str, value: float | None) -> str:
    """A noise floor, marked if it is a standard error."""
    mark = "±" if METRICS[metric].floor_is_error and value is not None else ""
    return mark + value_cell(metric, value)


def table_by_age(clips: Sequence[ClipResults]) -> str:
    """PSNR by the age of the history, the mean over clips, of each signal."""
    tables = []
    for signal, ours in by_signal(clips).items():
        rows = means_by_age(ours)
        lines = [[name, signal, *(value_cell("psnr", value) for value in row.values())] for name, row in rows.items()]
        tables.append(tabulate(lines, ["PSNR dB", "signal", *AGES], disable_numparse=True))
    return "\n\n".join(tables)


def results_table(clips: Sequence[ClipResults]) -> str:
    """One row per clip, signal and denoiser, with the noise floor below each signal."""
    lines = []
    for clip in clips:
        name = f"{clip.scene}/{clip.clip}"
        floors = clip.reference.metrics
        for result in clip.results:
            values = (value_cell(metric, result.metrics.get(metric), floors.get(metric)) for metric in PRINTED)
            lines.append([name, result.denoiser, clip.signal, *values, result.nonfinite])
        lines.append([name, FLOOR, clip.signal, *(floor_cell(metric, floors.get(metric)) for metric in PRINTED), ""])
    head = ["clip", "denoiser", "signal", *(METRICS[metric].title for metric in PRINTED), "non-finite"]
    text = tabulate(lines, head, disable_numparse=True)
    return f"{text}\n{LEGEND}" if NEAR_FLOOR in text else text
