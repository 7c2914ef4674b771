"""Means over frames and over clips, and what noise of the references leaves of them."""

from collections.abc import Sequence
from statistics import fmean

import numpy as np

from eval.metrics import METRICS, Values, within_floor


def means(frames: list[Values]) -> Values:
    """Arithmetic means over the frames where a metric is defined, None where it never is."""
    columns = {name: [row[name] for row in frames if row[name] is not None] for name in frames[0]}
    return {name: float(np.mean(values)) if values else None for name, values in columns.items()}  # type: ignore[arg-type]


def mean_floor(frames: list[Values]) -> Values:
    """Noise floors of means over frames, whose noise is independent: standard errors add up as variances."""
    floors = means(frames)
    for name, metric in METRICS.items():
        if metric.floor_is_error:
            errors = [row[name] for row in frames]
            floors[name] = float(np.linalg.norm(errors) / len(errors))  # type: ignore[arg-type]
    return floors


def joint_floor(clips: Sequence[Values], floors: Sequence[Values]) -> Values:
    """Noise floors of means over clips, where every clip is within its own: no clip's floor hides another's error."""

    def near(metric: str) -> bool:
        pairs = [(clip.get(metric), floor.get(metric)) for clip, floor in zip(clips, floors, strict=True)]
        return all(within_floor(metric, *pair) for pair in pairs if pair[0] is not None)

    return {metric: floor if near(metric) else None for metric, floor in mean_floor(list(floors)).items()}


def compared_mean(metric: str, clips: Sequence[Values], floors: Sequence[Values]) -> float | None:
    """What to compare means over clips by, in the digits shown: within its floor a clip counts as at its edge."""
    values = []
    for value, floor in ((c[metric], f.get(metric)) for c, f in zip(clips, floors, strict=True)):
        if value is not None:
            near = floor is not None and within_floor(metric, value, floor)
            values.append(METRICS[metric].edge(floor) if near else value)  # type: ignore[arg-type]
    return float(METRICS[metric].form.format(fmean(values))) if values else None
