"""Who is worth the time: the Pareto front of quality against time."""

from collections.abc import Mapping
from typing import NamedTuple


class Point(NamedTuple):
    """What a frame costs, and how good it becomes."""

    ms: float
    quality: float


def dominators(points: Mapping[str, Point], more_is_better: bool) -> dict[str, str | None]:
    """For every point the best of those no slower and no worse, and better in one; None on the Pareto front."""
    sign = 1 if more_is_better else -1

    def beats(a: Point, b: Point) -> bool:
        return a.ms <= b.ms and sign * a.quality >= sign * b.quality and a != b

    best_first = sorted(points, key=lambda name: (-sign * points[name].quality, points[name].ms))
    return {
        name: next((other for other in best_first if beats(points[other], point)), None)
        for name, point in points.items()
    }
