"""models.filters.eaw for the processor: every row by itself, every loop along it vectorised."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.exponential import exp
from models.compiled.jit import array, jit_in_any_order, jit_parallel, jit_with_memory
from models.filters.atrous import B3_SPLINE, RADIUS

SPLINE = np.array(B3_SPLINE, np.float32)
NEGLIGIBLE = np.float32(30)  # e^-30 = 1e-13 counts as 0: denormal numbers are slow


@jit_in_any_order
def decay(a: Any) -> Any:
    """e^-a for a >= 0."""
    return exp(-min(a, NEGLIGIBLE)) if a < NEGLIGIBLE else np.float32(0)


@jit_in_any_order
def columns_with_tap(row: Any, dx: int, dy: int, height: int, width: int) -> Any:
    """The columns, first and beyond the last, of a row whose tap at (dx, dy) is in the image."""
    outside = row + dy < 0 or row + dy >= height
    return (0, 0) if outside else (max(0, -dx), min(width, width - dx))


@jit_in_any_order
def feature_distances(apart: Any, features: Any, row: int, left: int, dx: int, dy: int) -> None:
    """apart (n): squared distances of features (C, H, W) of n pixels of a row, from `left` on, to their taps."""
    right = left + apart.size
    for i in range(apart.size):
        apart[i] = 0
    for c in range(len(features)):
        here = features[c, row, left:right]
        there = features[c, row + dy, left + dx : right + dx]
        for i in range(apart.size):
            apart[i] += (here[i] - there[i]) * (here[i] - there[i])


@jit_in_any_order
def add_eaw_tap(sums: Any, h: Any, apart: Any, colour: Any, row: int, left: int, dx: int, dy: int) -> None:
    """Add one tap of the n pixels from `left` on in a row to sums (4, W): of weights, of colours (3, H, W)."""
    right = left + apart.size
    to = row + dy
    to_left = left + dx
    to_right = right + dx
    total = sums[0, left:right]
    red = sums[1, left:right]
    green = sums[2, left:right]
    blue = sums[3, left:right]
    r = colour[0, to, to_left:to_right]
    g = colour[1, to, to_left:to_right]
    b = colour[2, to, to_left:to_right]
    for i in range(apart.size):
        w = h * decay(apart[i])
        total[i] += w
        red[i] += w * r[i]
        green[i] += w * g[i]
        blue[i] += w * b[i]


@jit_in_any_order
def divide(line: Any, sums: Any, weights: Any) -> None:
    for x in range(line.size):
        line[x] = sums[x] / weights[x]


@jit_with_memory
def filter_eaw_row(out: Any, row: Any, colour: Any, features: Any, step: int) -> None:
    """A row of out (3, H, W)."""
    _, height, width = colour.shape
    sums = np.zeros((4, width), np.float32)
    space = np.empty(width, np.float32)
    for j in range(-RADIUS, RADIUS + 1):
        for i in range(-RADIUS, RADIUS + 1):
            dx = i * step
            dy = j * step
            left, right = columns_with_tap(row, dx, dy, height, width)
            if left >= right:
                continue
            apart = space[: right - left]
            feature_distances(apart, features, row, left, dx, dy)
            add_eaw_tap(sums, SPLINE[j + RADIUS] * SPLINE[i + RADIUS], apart, colour, row, left, dx, dy)
    for c in range(3):
        divide(out[c, row], sums[c + 1], sums[0])


@jit_parallel
def filter_eaw_image(out: Any, colour: Any, features: Any, step: int) -> None:
    for row in numba.prange(colour.shape[1]):
        filter_eaw_row(out, np.int64(row), colour, features, step)


def eaw_level(colour: Tensor, features: Tensor, step: int) -> Tensor:
    """See models.filters.eaw.eaw_level."""
    out = torch.empty_like(colour, memory_format=torch.contiguous_format)
    for item in range(len(colour)):
        filter_eaw_image(out[item].numpy(), array(colour[item]), array(features[item]), step)
    return out
