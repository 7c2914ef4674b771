"""models.filters.neighbours for the processor: rows in parallel, every loop along them vectorised."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.channels import LUMINANCE_WEIGHTS
from models.compiled.eaw import columns_with_tap
from models.compiled.jit import array, jit_in_any_order, jit_parallel
from models.compiled.lines import add_line, add_product
from models.operators import MAX_LUMINANCE

MIN_MEAN = 1e-20  # smallest luminance that deviations are divided by
ONE = np.float32(1)
ZERO = np.float32(0)
RED_WEIGHT, GREEN_WEIGHT, BLUE_WEIGHT = (np.float32(weight) for weight in LUMINANCE_WEIGHTS)
SUMS = 6  # red, green, blue, luminance, its square, pixels


@jit_in_any_order
def compare(same: Any, mesh: Any, other: Any) -> None:
    for x in range(same.size):
        same[x] = ONE if mesh[x] == other[x] else ZERO


@jit_in_any_order
def add_luminances(first: Any, second: Any, same: Any, red: Any, green: Any, blue: Any) -> None:
    for x in range(same.size):
        y = min(RED_WEIGHT * red[x] + GREEN_WEIGHT * green[x] + BLUE_WEIGHT * blue[x], np.float32(MAX_LUMINANCE))
        first[x] += same[x] * y
        second[x] += same[x] * y * y


@jit_in_any_order
def add_pixels(sums: Any, y: Any, low: Any, high: Any, same: Any, image: Any, to: Any, dx: Any) -> None:
    there = slice(low + dx, high + dx)
    red, green, blue = image[0, to, there], image[1, to, there], image[2, to, there]
    add_product(sums[0, y, low:high], same, red)
    add_product(sums[1, y, low:high], same, green)
    add_product(sums[2, y, low:high], same, blue)
    add_luminances(sums[3, y, low:high], sums[4, y, low:high], same, red, green, blue)
    add_line(sums[5, y, low:high], same)


@jit_in_any_order
def divide(line: Any, total: Any, count: Any) -> None:
    for x in range(line.size):
        line[x] = total[x] / count[x]


@jit_in_any_order
def spread(line: Any, first: Any, second: Any, count: Any) -> None:
    for x in range(line.size):
        mean = first[x] / count[x]
        variance = max(second[x] / count[x] - mean * mean, ZERO)
        line[x] = np.sqrt(variance) / max(mean, np.float32(MIN_MEAN))


@jit_parallel
def sum_close(sums: Any, image: Any, mesh: Any) -> None:
    """sums (SUMS, H, W) over 3 x 3 pixels from image (3, H, W) and mesh (H, W)."""
    height, width = mesh.shape
    for row in numba.prange(height):
        y = np.int64(row)
        same = np.empty(width, np.float32)
        sums[:, y] = ZERO
        for tap in range(9):
            dy, dx = tap // 3 - 1, tap % 3 - 1
            low, high = columns_with_tap(y, dx, dy, height, width)
            if low >= high:
                continue
            compare(same[low:high], mesh[y, low:high], mesh[y + dy, low + dx : high + dx])
            add_pixels(sums, y, low, high, same[low:high], image, y + dy, dx)


@jit_parallel
def average(near: Any, around: Any, deviation: Any, close: Any, mesh: Any) -> None:
    """near and around (3, H, W) and deviation (H, W) from the sums over 3 x 3 pixels."""
    height, width = mesh.shape
    for row in numba.prange(height):
        y = np.int64(row)
        same = np.empty(width, np.float32)
        sums = np.zeros((SUMS, width), np.float32)
        for tap in range(9):
            dy, dx = 3 * (tap // 3 - 1), 3 * (tap % 3 - 1)
            low, high = columns_with_tap(y, dx, dy, height, width)
            if low >= high:
                continue
            compare(same[low:high], mesh[y, low:high], mesh[y + dy, low + dx : high + dx])
            for c in range(SUMS):
                add_product(sums[c, low:high], same[low:high], close[c, y + dy, low + dx : high + dx])
        for c in range(3):
            divide(near[c, y], close[c, y], close[SUMS - 1, y])
            divide(around[c, y], sums[c], sums[SUMS - 1])
        spread(deviation[y], sums[3], sums[4], sums[SUMS - 1])


@jit_parallel
def sum_taps(sums: Any, image: Any, mesh: Any, step: Any) -> None:
    """sums (C, H, W) over 3 x 3 taps `step` pixels apart, from image (C, H, W) and mesh (H, W)."""
    height, width = mesh.shape
    for row in numba.prange(height):
        y = np.int64(row)
        same = np.empty(width, np.float32)
        sums[:, y] = ZERO
        for tap in range(9):
            dy, dx = step * (tap // 3 - 1), step * (tap % 3 - 1)
            low, high = columns_with_tap(y, dx, dy, height, width)
            if low >= high:
                continue
            compare(same[low:high], mesh[y, low:high], mesh[y + dy, low + dx : high + dx])
            for c in range(image.shape[0]):
                add_product(sums[c, y, low:high], same[low:high], image[c, y + dy, low + dx : high + dx])


def mesh_sums(image: Tensor, mesh_id: Tensor, step: int) -> Tensor:
    """See models.filters.neighbours.mesh_sums."""
    sums = torch.empty_like(image, memory_format=torch.contiguous_format)
    for item in range(len(image)):
        sum_taps(sums[item].numpy(), array(image[item]), array(mesh_id[item, 0]), step)
    return sums


def mesh_means(image: Tensor, mesh_id: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """See models.filters.neighbours.mesh_means."""
    batch, _, height, width = image.shape
    near = torch.empty(batch, 3, height, width)
    around = torch.empty(batch, 3, height, width)
    deviation = torch.empty(batch, 1, height, width)
    close = np.empty((SUMS, height, width), np.float32)
    for item in range(batch):
        mesh = array(mesh_id[item, 0])
        sum_close(close, array(image[item]), mesh)
        average(near[item].numpy(), around[item].numpy(), deviation[item, 0].numpy(), close, mesh)
    return near, around, deviation
