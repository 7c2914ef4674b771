"""models.filters.sbf for the CPU: rows in parallel, every loop along them vectorised."""

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.affinity import STRIDE, measure
from models.compiled.arrays import Image, Index, Plane, Row, Rows, Scalar, Signals
from models.compiled.eaw import decay
from models.compiled.jit import array, jit_in_any_order, jit_parallel, jit_with_memory
from models.compiled.lines import window_taps


@jit_in_any_order
def decay_line(line: Row) -> None:
    for x in range(line.size):
        line[x] = decay(line[x])


@jit_in_any_order
def add_scaled(line: Row, scale: Scalar, weight: Row, image: Row) -> None:
    for x in range(line.size):
        line[x] += scale * weight[x] * image[x]


@jit_with_memory
def sum_row(sums: Signals, row: Index, image: Image, guides: Rows, gaussians: Plane) -> None:
    """A row of sums (S, C, H, W) from image (C, H, W), guides (F, N), gaussians (2 radius + 1, S)."""
    channels, height, width = image.shape
    taps, filters = gaussians.shape
    radius = taps // 2
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


@jit_parallel
def sum_image(sums: Signals, image: Image, guides: Rows, gaussians: Plane) -> None:
    for row in numba.prange(image.shape[1]):
        sum_row(sums, np.int64(row), image, guides, gaussians)


def window_sums(image: Tensor, guides: Tensor, gaussians: Tensor) -> Tensor:
    batch, channels, height, width = image.shape
    sums = torch.empty(batch, gaussians.shape[1], channels, height, width)
    flat = F.pad(guides.flatten(2), (0, 0, 0, -guides.shape[1] % STRIDE))  # features are compared so many at a time
    for item in range(batch):
        sum_image(sums[item].numpy(), array(image[item]), array(flat[item]), array(gaussians))
    return sums
