"""The Pareto front of quality against time."""

from collections.abc import Mapping
from typing import NamedTuple

from eval.metrics import METRICS


class Point(NamedTuple):
    """Milliseconds per frame, and the value of a metric."""

    ms: float
    quality: float

    @staticmethod
    def of(ms: float | None, quality: float | None) -> "Point | None":
        """None where the time was not measured or the metric is undefined."""
        return None if ms is None or quality is None else Point(ms, quality)


def dominated_by_name(points: Mapping[str, Point | None], metric: str) -> dict[str, str | None]:
    """For every name, the best of those that are no slower and no worse, and better in one; None on the front.

    Names without a point are left out.
    """
    present = {name: point for name, point in points.items() if point}
    sign = 1 if METRICS[metric].more_is_better else -1

    def dominates(a: Point, b: Point) -> bool:
        return a.ms <= b.ms and sign * a.quality >= sign * b.quality and a != b

    best_first = sorted(present, key=lambda name: (-sign * present[name].quality, present[name].ms))
    return {
        name: next((other for other in best_first if dominates(present[other], point)), None)
        for name, point in present.items()
    }
