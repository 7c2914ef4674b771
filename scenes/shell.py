"""The empty room: floor, ceiling and walls with rectangular openings."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from scenes.animation import still
from scenes.camera import Array
from scenes.meshes import Surface, flat_shaded, join, sheet, slab


def pose(x: float, y: float, z: float, angle: float) -> Array:
    """object_to_world (4, 4) at (x, y, z), rotated by `angle` radians about the vertical axis."""
    return still((x, y, z), angle).matrix(0)


@dataclass(frozen=True)
class Opening:
    """A hole in a wall, as visible from inside; metres."""

    low: tuple[float, float]  # x to the right of the wall's middle, y above the floor
    high: tuple[float, float]

    @property
    def middle(self) -> tuple[float, float]:
        return (self.low[0] + self.high[0]) / 2, (self.low[1] + self.high[1]) / 2

    @property
    def width(self) -> float:
        return self.high[0] - self.low[0]

    @property
    def height(self) -> float:
        return self.high[1] - self.low[1]


def wall_with_openings(width: float, height: float, openings: list[Opening]) -> Surface:
    """A rectangle in the xy plane on the origin, facing +z, with holes; texture coordinates in metres."""
    xs = np.unique([-width / 2, width / 2, *(e for o in openings for e in (o.low[0], o.high[0]))])
    ys = np.unique([0.0, height, *(e for o in openings for e in (o.low[1], o.high[1]))])
    cells = []
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            x, y = (x0 + x1) / 2, (y0 + y1) / 2
            if not any(o.low[0] < x < o.high[0] and o.low[1] < y < o.high[1] for o in openings):
                points = np.array([[(x0, y0, 0), (x1, y0, 0)], [(x0, y1, 0), (x1, y1, 0)]])
                cells.append(sheet(points, points[..., :2]))
    return join(cells)


def reveal(opening: Opening, thickness: float) -> Surface:
    """The four sides of an opening through a wall of that thickness, behind the plane z = 0."""
    border = 0.02
    (left, bottom), (right, top) = opening.low, opening.high
    level = slab(opening.width + 2 * border, border, thickness)
    upright = slab(border, opening.height, thickness)
    sides = [level.at(opening.middle[0], y, -thickness / 2) for y in (bottom - border, top)]
    return join(sides + [upright.at(x, bottom, -thickness / 2) for x in (left - border / 2, right + border / 2)])


def horizontal_rectangle(width: float, depth: float) -> Surface:
    """A rectangle in the xz plane, facing up."""
    x, z = width / 2, depth / 2
    return flat_shaded(np.array([(-x, 0, z), (x, 0, z), (x, 0, -z), (-x, 0, -z)]), np.array([[0, 1, 2], [0, 2, 3]]))
