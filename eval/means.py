"""Means over frames and clips, and their noise floors."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np

from eval.metrics import METRICS, Values, within_floor
from eval.results import ClipResults


def means(frames: list[Values]) -> Values:
    """Arithmetic means over the frames where a metric is defined, None where it never is."""
    names = dict.fromkeys(name for row in frames for name in row)
    columns = {name: [row[name] for row in frames if row.get(name) is not None] for name in names}
    return {name: float(np.mean(values)) if values else None for name, values in columns.items()}  # type: ignore[arg-type]


def mean_floor(frames: list[Values]) -> Values:
    """Noise floors of means over frames with independent noise: the squares of standard errors add up."""
    floors = means(frames)
    for name, metric in METRICS.items():
        errors = [error for row in frames if (error := row.get(name)) is not None]
        if metric.floor_is_error and errors:
            floors[name] = float(np.linalg.norm(errors) / len(errors))
    return floors


# A recurrent denoiser has no history in the first frame, some in the fifth, and is steady from the 16th on.
AGES = {"first frame": slice(0, 1), "fifth": slice(4, 5), "from the 16th on": slice(15, None)}


def means_by_age(clips: Sequence[ClipResults], metric: str = "psnr") -> dict[str, dict[str, float | None]]:
    """A metric of each denoiser by AGES, the mean over clips of one signal; None where no clip is that long."""
    rows: dict[str, dict[str, float | None]] = {}
    for denoiser in dict.fromkeys(result.denoiser for clip in clips for result in clip.results):
        results = [result for clip in clips for result in clip.results if result.denoiser == denoiser]
        for age, frames in AGES.items():
            chosen = [means(result.frames[frames]).get(metric) for result in results]
            values = [value for value in chosen if value is not None]
            rows.setdefault(denoiser, {})[age] = fmean(values) if values else None
    return rows


@dataclass(frozen=True)
class ClipScores:
    """A denoiser's metrics on several clips, and the noise floors of these."""

    values: list[Values]
    floors: list[Values]

    @property
    def means(self) -> Values:
        return means(self.values)

    @property
    def joint_floor(self) -> Values:
        """Noise floors of the means; None unless every clip is within its own floor."""

        def near(metric: str) -> bool:
            pairs = [
                (clip.get(metric), floor.get(metric)) for clip, floor in zip(self.values, self.floors, strict=True)
            ]
            return all(within_floor(metric, *pair) for pair in pairs if pair[0] is not None)

        return {metric: floor if near(metric) else None for metric, floor in mean_floor(self.floors).items()}

    def compared(self, metric: str) -> float | None:
        """The mean, in the digits shown, by which denoisers are ranked.

        The value of a clip within its noise floor is replaced by the floor's edge. None where it is never defined.
        """
        values = []
        for value, floor in ((c[metric], f.get(metric)) for c, f in zip(self.values, self.floors, strict=True)):
            if value is not None:
                near = floor is not None and within_floor(metric, value, floor)
                values.append(METRICS[metric].edge(floor) if near else value)  # type: ignore[arg-type]
        return float(METRICS[metric].form.format(fmean(values))) if values else None


def scores_of(clips: Sequence[ClipResults], denoiser: str) -> ClipScores:
    """The denoiser's scores on those of the clips, all of one signal, that have results of it."""
    pairs = [(result, clip.reference) for clip in clips for result in clip.results if result.denoiser == denoiser]
    return ClipScores([result.metrics for result, _ in pairs], [reference.metrics for _, reference in pairs])
