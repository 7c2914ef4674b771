"""Windows with holes: what the edge-avoiding à-trous filters EAW and SVGF share (Dammertz et al. 2010).

Images are (..., H, W). Taps outside the image are left out, so that weights are normalised over the others.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import EllipsisType

from torch import Tensor

from models.operators import STRIP_ROWS

ATROUS_LEVELS = 5
B3_SPLINE = (1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16)  # h, separable
RADIUS = len(B3_SPLINE) // 2
CENTRE = B3_SPLINE[RADIUS] ** 2

Region = tuple[EllipsisType, slice, slice]


@dataclass(frozen=True)
class Tap:
    """One place q = p + (dx, dy) of a window, for the pixels p of a strip whose q lies in the image."""

    dx: int
    dy: int
    p: Region
    q: Region


def strip_taps(size: Sequence[int], radius: int, step: int = 1) -> Iterator[Tap]:
    """A window of (2 radius + 1)² places `step` pixels apart, without its centre, strip by strip of an image (H, W)."""
    height, width = size
    offsets = range(-radius * step, radius * step + 1, step)
    for start in range(0, height, STRIP_ROWS):
        for dy, dx in itertools.product(offsets, offsets):
            top = max(start, -dy)
            bottom = min(start + STRIP_ROWS, height, height - dy)
            left = max(0, -dx)
            right = min(width, width - dx)
            if (dx or dy) and top < bottom and left < right:
                p = (..., slice(top, bottom), slice(left, right))
                q = (..., slice(top + dy, bottom + dy), slice(left + dx, right + dx))
                yield Tap(dx, dy, p, q)


class WindowSum:
    """The sum of an image's values over every pixel's window, weighted; begun with the pixel itself."""

    def __init__(self, image: Tensor, centre: float):
        self.image = image
        self.sum = centre * image

    def add(self, tap: Tap, weight: Tensor) -> None:
        self.sum[tap.p].addcmul_(weight, self.image[tap.q])


def b3_spline(tap: Tap, step: int) -> float:
    """h(q), the weight of one tap of a level whose taps are `step` pixels apart."""
    return B3_SPLINE[RADIUS + tap.dx // step] * B3_SPLINE[RADIUS + tap.dy // step]
