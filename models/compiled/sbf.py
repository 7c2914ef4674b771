"""models.filters.sbf for the CPU: rows in parallel, every loop along them vectorised."""

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.affinity import STRIDE, measure
from models.compiled.arrays import Image, Plane, Row, Rows, Scalar, Signals
from models.compiled.eaw import decay
from models.compiled.jit import array, jit_in_any_order, jit_parallel, run_items
from models.compiled.lines import window_taps


@jit_in_any_order
def decay_line(line: Row) -> None:
    for x in range(line.size):
        line[x] = decay(line[x])


@jit_in_any_order
def add_scaled(line: Row, scale: Scalar, weight: Row, image: Row) -> None:
    for x in range(line.size):
        line[x] += scale * weight[x] * image[x]


@jit_parallel
def sum_image(sums: Signals, image: Image, guides: Rows, gaussians: Plane) -> None:
    """sums (S, C, H, W) from image (C, H, W), guides (F, N), gaussians (2 radius + 1, S)."""
    channels, height, width = image.shape
    taps, filters = gaussians.shape
    radius = taps // 2
    for number in numba.prange(height):
        row = np.int64(number)
        space = np.empty(width, np.float32)
        sums[:, :, row] = 0
        for dx, dy, left, right in window_taps(row, radius, 1, height, width):
            weight = space[: right - left]
            measure(weight, guides, row * width + left, row * width + right, dy * width + dx)
            decay_line(weight)
            for s in range(filters):
                scale = gaussians[radius + dy, s] * gaussians[radius + dx, s]
                if scale > 0:
                    for c in range(channels):
                        there = image[c, row + dy, left + dx : right + dx]
                        add_scaled(sums[s, c, row, left:right], scale, weight, there)


def window_sums(image: Tensor, guides: Tensor, gaussians: Tensor) -> Tensor:
    batch, channels, height, width = image.shape
    sums = torch.empty(batch, gaussians.shape[1], channels, height, width)
    flat = F.pad(guides.flatten(2), (0, 0, 0, -guides.shape[1] % STRIDE))  # features are compared so many at a time
    run_items(sum_image, [sums], [image, flat], array(gaussians))
    return sums
