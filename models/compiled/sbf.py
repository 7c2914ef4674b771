"""models.filters.sbf for the processor: every row by itself, every loop along it vectorised."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.affinity import STRIDE, measure
from models.compiled.eaw import columns_with_tap, decay
from models.compiled.jit import array, jit_in_any_order, jit_parallel, jit_with_memory


@jit_in_any_order
def decay_line(line: Any) -> None:
    for x in range(line.size):
        line[x] = decay(line[x])


@jit_in_any_order
def add_scaled(line: Any, scale: Any, weight: Any, image: Any) -> None:
    for x in range(line.size):
        line[x] += scale * weight[x] * image[x]


@jit_with_memory
def sum_row(sums: Any, row: Any, image: Any, guides: Any, gaussians: Any) -> None:
    """A row of sums (S, C, H, W) from image (C, H, W), guides (F, H * W), gaussians (2 radius + 1, S)."""
    channels, height, width = image.shape
    taps, filters = gaussians.shape
    radius = taps // 2
    space = np.empty(width, np.float32)
    sums[:, :, row] = 0
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            left, right = columns_with_tap(row, dx, dy, height, width)
            if left >= right:
                continue
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
def sum_image(sums: Any, image: Any, guides: Any, gaussians: Any) -> None:
    for row in numba.prange(image.shape[1]):
        sum_row(sums, np.int64(row), image, guides, gaussians)


def window_sums(image: Tensor, guides: Tensor, gaussians: Tensor) -> Tensor:
    """See models.filters.sbf.window_sums."""
    batch, channels, height, width = image.shape
    sums = torch.empty(batch, gaussians.shape[1], channels, height, width)
    flat = F.pad(guides.flatten(2), (0, 0, 0, -guides.shape[1] % STRIDE))  # features are compared so many at a time
    for item in range(batch):
        sum_image(sums[item].numpy(), array(image[item]), array(flat[item]), array(gaussians))
    return sums
