"""models.filters.eaw for the CPU: rows in parallel, every loop along them vectorised."""

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.arrays import RGB, Image, Index, Row, Rows, Scalar, f32
from models.compiled.exponential import exp
from models.compiled.jit import jit_in_any_order, jit_parallel, run_items
from models.compiled.lines import add_square, divide_line, triple, triple_of_lines, window_taps
from models.filters.atrous import RADIUS, SPLINE

MAX_DECAY = 30  # e^-30 = 1e-13 counts as 0: denormal numbers are slow


@jit_in_any_order
def decay(a: Scalar) -> Scalar:
    """e^-a for a >= 0."""
    return exp(-min(a, f32(MAX_DECAY))) if a < f32(MAX_DECAY) else f32(0)


@jit_in_any_order
def add_tap(sums: RGB, total: Row, h: Scalar, distance: Row, colour: RGB) -> None:
    """Add one tap of n pixels, weighted by h exp(-distance), to the sums of colours and of weights."""
    red, green, blue = sums
    from_red, from_green, from_blue = colour
    for i in range(distance.size):
        w = h * decay(distance[i])
        total[i] += w
        red[i] += w * from_red[i]
        green[i] += w * from_green[i]
        blue[i] += w * from_blue[i]


@jit_in_any_order
def sum_row(sums: Rows, space: Row, row: Index, colour: Image, features: Image, step: int) -> None:
    """Add all taps of a row to sums (4, W), of colours and of weights; space (W) is scratch."""
    _, height, width = colour.shape
    for dx, dy, left, right in window_taps(row, RADIUS, step, height, width):
        distance = space[: right - left]
        distance[:] = f32(0)
        for c in range(len(features)):
            add_square(distance, features[c, row, left:right], features[c, row + dy, left + dx : right + dx])
        h = SPLINE[dy // step + RADIUS] * SPLINE[dx // step + RADIUS]
        there = triple(colour, row + dy, left + dx, right + dx)
        add_tap(triple_of_lines(sums, left, right), sums[3, left:right], h, distance, there)


@jit_parallel
def filter_image(out: Image, colour: Image, features: Image, step: int) -> None:
    _, height, width = colour.shape
    for number in numba.prange(height):
        row = np.int64(number)
        sums = np.zeros((4, width), np.float32)
        sum_row(sums, np.empty(width, np.float32), row, colour, features, step)
        for c in range(3):
            divide_line(out[c, row], sums[c], sums[3])


def eaw_level(colour: Tensor, features: Tensor, step: int) -> Tensor:
    out = torch.empty_like(colour, memory_format=torch.contiguous_format)
    run_items(filter_image, [out], [colour, features], step)
    return out
