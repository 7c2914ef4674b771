"""Results for people: numbers as text, marked where the reference's own noise decides them."""

from collections.abc import Sequence
from statistics import fmean

from tabulate import tabulate

from eval.metrics import METRICS
from eval.noise_floor import floor_limit, within_floor
from eval.results import FLOOR, ClipResults, Values, mean_floor

PRINTED = ("rmse", "psnr", "ssim", "flip", "mse_unbiased", "temporal_error", "disocclusion_l1")
NEAR = "≈"
LEGEND = f"{NEAR} within the noise floor: as close to the truth as the reference itself, so the digits mean nothing"


def cell(metric: str, value: float | None, floor: float | None = None) -> str:
    """A number, marked if it is within its noise floor."""
    if value is None:
        return "-"
    mark = NEAR if within_floor(metric, value, floor) else ""
    return mark + METRICS[metric].form.format(value)


def joint_floor(clips: Sequence[Values], floors: Sequence[Values]) -> Values:
    """Noise floors of means over clips, where every clip is within its own: no clip's floor hides another's error."""

    def near(metric: str) -> bool:
        pairs = [(clip.get(metric), floor.get(metric)) for clip, floor in zip(clips, floors, strict=True)]
        return all(within_floor(metric, *pair) for pair in pairs if pair[0] is not None)

    return {metric: floor if near(metric) else None for metric, floor in mean_floor(list(floors)).items()}


def compared(metric: str, clips: Sequence[Values], floors: Sequence[Values]) -> float | None:
    """What to compare means over clips by, in the digits shown: within its floor a clip counts as at its edge."""
    values = []
    for value, floor in ((c[metric], f.get(metric)) for c, f in zip(clips, floors, strict=True)):
        if value is not None:
            near = floor is not None and within_floor(metric, value, floor)
            values.append(floor_limit(metric, floor) if near else value)  # type: ignore[arg-type]
    return float(METRICS[metric].form.format(fmean(values))) if values else None


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
