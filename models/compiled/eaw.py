"""models.eaw for the processor."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled import array, jit, jit_parallel, threads
from models.compiled.svgf import SPLINE, decay, reach


@jit
def distances(apart: Any, features: Any, row: int, left: int, dx: int, dy: int) -> None:
    """apart (n): squared distances of features (C, H, W) of n pixels of a row, from `left` on, to their taps."""
    right, ahead, behind = left + apart.size, left + dx, left + dx + apart.size
    apart[:] = 0
    for c in range(len(features)):
        here, there = features[c, row, left:right], features[c, row + dy, ahead:behind]
        for i in range(apart.size):
            apart[i] += (here[i] - there[i]) * (here[i] - there[i])


@jit
def add_tap(sums: Any, h: Any, apart: Any, colour: Any, row: int, left: int, dx: int, dy: int) -> None:
    """Add one tap of the n pixels from `left` on in a row to sums (4, W): of weights, of colours (3, H, W)."""
    to, right, ahead, behind = row + dy, left + apart.size, left + dx, left + dx + apart.size
    total, red, green, blue = sums[0, left:right], sums[1, left:right], sums[2, left:right], sums[3, left:right]
    r, g, b = colour[0, to, ahead:behind], colour[1, to, ahead:behind], colour[2, to, ahead:behind]
    for i in range(apart.size):
        w = h * decay(apart[i])
        total[i] += w
        red[i] += w * r[i]
        green[i] += w * g[i]
        blue[i] += w * b[i]


@jit
def filter_row(out: Any, row: Any, colour: Any, features: Any, step: int) -> None:
    """A row of out (3, H, W)."""
    _, height, width = colour.shape
    sums, space = np.empty((4, width), np.float32), np.empty(width, np.float32)
    h = SPLINE[2] * SPLINE[2]
    sums[0], sums[1:] = h, h * colour[:, row]
    for j in range(-2, 3):
        for i in range(-2, 3):
            dx, dy = i * step, j * step
            left, right = reach(row, dx, dy, height, width)
            if left >= right:
                continue
            apart = space[: right - left]
            distances(apart, features, row, left, dx, dy)
            add_tap(sums, SPLINE[j + 2] * SPLINE[i + 2], apart, colour, row, left, dx, dy)
    for c in range(3):
        out[c, row] = sums[c + 1] / sums[0]


@jit_parallel
def filter_image(out: Any, colour: Any, features: Any, step: int) -> None:
    for row in numba.prange(colour.shape[1]):
        filter_row(out, np.int64(row), colour, features, step)


def filter_level(colour: Tensor, features: Tensor, step: int) -> Tensor:
    """See models.eaw.filter_level."""
    threads()
    out = torch.empty_like(colour, memory_format=torch.contiguous_format)
    for item in range(len(colour)):
        filter_image(out[item].numpy(), array(colour[item]), array(features[item]), step)
    return out
