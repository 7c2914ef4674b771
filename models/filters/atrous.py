"""Windows with holes (à trous), which the edge-avoiding filters share (Dammertz et al. 2010).

Images are (..., C, H, W). Taps outside the image are skipped, and weights normalised over the others.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from types import EllipsisType

import numpy as np
import torch
from torch import Tensor

from models.operators import STRIP_ROWS

ATROUS_STEPS = (1, 2, 4, 8, 16)  # px from tap to tap, level by level
B3_SPLINE = (1 / 16, 1 / 4, 3 / 8, 1 / 4, 1 / 16)  # h, separable
SPLINE = np.array(B3_SPLINE, np.float32)  # for kernels
RADIUS = len(B3_SPLINE) // 2
CENTRE = B3_SPLINE[RADIUS] ** 2


@dataclass(frozen=True)
class Tap:
    """An offset (dx, dy) of a window, with the pixels p of a strip whose q = p + (dx, dy) lies in the image."""

    dx: int
    dy: int
    p: tuple[EllipsisType, slice, slice]
    q: tuple[EllipsisType, slice, slice]


def strip_taps(size: Sequence[int], radius: int, step: int = 1) -> Iterator[Tap]:
    """The taps of windows of (2 radius + 1)² pixels, `step` apart, without the centre, by strips of (H, W)."""
    offsets = range(-radius * step, radius * step + 1, step)
    return offset_taps(size, offsets, offsets)


def offset_taps(size: Sequence[int], down: Iterable[int], across: Iterable[int]) -> Iterator[Tap]:
    """The taps of windows of the product of offsets `down` and `across`, without the centre, by strips of (H, W)."""
    height, width = size
    for start in range(0, height, STRIP_ROWS):
        for dy, dx in itertools.product(down, across):
            top = max(start, -dy)
            bottom = min(start + STRIP_ROWS, height, height - dy)
            left = max(0, -dx)
            right = min(width, width - dx)
            if (dx or dy) and top < bottom and left < right:
                p = (..., slice(top, bottom), slice(left, right))
                q = (..., slice(top + dy, bottom + dy), slice(left + dx, right + dx))
                yield Tap(dx, dy, p, q)


def window_mean(image: Tensor, centre: float, taps: Iterable[Tap], weight: Callable[[Tap], Tensor]) -> Tensor:
    """Means of an image (..., C, H, W) over windows, of `centre` times the pixel itself and `weight` (..., 1, h, w)."""
    total = torch.full_like(image[..., :1, :, :], centre)
    weighted = centre * image
    for tap in taps:
        tap_weight = weight(tap)
        total[tap.p].add_(tap_weight)
        weighted[tap.p].addcmul_(tap_weight, image[tap.q])
    return weighted / total


def b3_spline(tap: Tap, step: int) -> float:
    """h(q), the weight of a tap on a level whose taps are `step` pixels apart."""
    return B3_SPLINE[RADIUS + tap.dx // step] * B3_SPLINE[RADIUS + tap.dy // step]
