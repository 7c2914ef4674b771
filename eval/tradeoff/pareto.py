"""The Pareto front of quality against time."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from eval.means import ClipScores
from eval.metrics import METRICS


class Point(NamedTuple):
    """Milliseconds per frame, and the value of a metric."""

    ms: float
    quality: float

    @staticmethod
    def of(ms: float | None, quality: float | None) -> "Point | None":
        """None where the time was not measured or the metric is undefined."""
        return None if ms is None or quality is None else Point(ms, quality)


@dataclass(frozen=True)
class TimedScores:
    """A denoiser's scores and its milliseconds per frame; None where these were not measured."""

    ms: float | None
    scores: ClipScores

    def mean(self, metric: str) -> Point | None:
        """Its position in plots."""
        return Point.of(self.ms, self.scores.means[metric])

    def compared(self, metric: str) -> Point | None:
        """The point by which it is ranked."""
        return Point.of(self.ms, self.scores.compared(metric))


def dominated_by_name(offers: Mapping[str, TimedScores], metric: str) -> dict[str, str | None]:
    """The name that dominates each name; None on the front. Names without a time or value are left out."""
    points = {name: point for name, offer in offers.items() if (point := offer.compared(metric))}
    return dominators(points, METRICS[metric].more_is_better)


def dominators(points: Mapping[str, Point], more_is_better: bool) -> dict[str, str | None]:
    """For every point, the best of those that are no slower and no worse, and better in one; None on the front."""
    sign = 1 if more_is_better else -1

    def dominates(a: Point, b: Point) -> bool:
        return a.ms <= b.ms and sign * a.quality >= sign * b.quality and a != b

    best_first = sorted(points, key=lambda name: (-sign * points[name].quality, points[name].ms))
    return {
        name: next((other for other in best_first if dominates(points[other], point)), None)
        for name, point in points.items()
    }
