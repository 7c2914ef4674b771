"""models.filters.neighbours for the CPU: rows in parallel, every loop along them vectorised."""

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.arrays import RGB, Image, Index, Plane, Row, f32
from models.compiled.jit import jit_in_any_order, jit_parallel, jit_with_memory, run_items
from models.compiled.lines import add_line, add_product, divide_line, luminance, triple, window_taps
from models.operators import MAX_LUMINANCE

MIN_MEAN = 1e-20  # smallest luminance that deviations are divided by
SUMS = 6  # red, green, blue, luminance, its square, pixels


@jit_in_any_order
def compare(same: Row, mesh: Row, other: Row) -> None:
    for x in range(same.size):
        same[x] = f32(1) if mesh[x] == other[x] else f32(0)


@jit_in_any_order
def add_luminances(first: Row, second: Row, same: Row, colour: RGB) -> None:
    """Add the luminance, and its square, of pixels of the same mesh."""
    red, green, blue = colour
    for x in range(same.size):
        y = min(luminance(red[x], green[x], blue[x]), f32(MAX_LUMINANCE))
        first[x] += same[x] * y
        second[x] += same[x] * y * y


@jit_in_any_order
def set_relative_deviation(line: Row, first: Row, second: Row, count: Row) -> None:
    """√(E[y²] - E[y]²) / E[y], from sums of y, of y² and of pixels."""
    for x in range(line.size):
        mean = first[x] / count[x]
        line[x] = mean * mean
    for x in range(line.size):
        # Of pixels that are all alike this is exactly 0, as long as the square is rounded: it has a loop of its own.
        variance = max(second[x] / count[x] - line[x], f32(0))
        line[x] = np.sqrt(variance) / max(first[x] / count[x], f32(MIN_MEAN))


@jit_with_memory
def sum_row(sums: Image, to: Index, image: Image, mesh: Plane, row: Index, step: int) -> None:
    """Row `to` of sums (C, ·, W) over 3 x 3 taps `step` pixels apart of the same mesh, of a row of image (C, H, W)."""
    height, width = mesh.shape
    space = np.empty(width, np.float32)
    sums[:, to] = 0
    for dx, dy, left, right in window_taps(row, 1, step, height, width):
        same = space[left:right]
        compare(same, mesh[row, left:right], mesh[row + dy, left + dx : right + dx])
        for c in range(len(image)):
            add_product(sums[c, to, left:right], same, image[c, row + dy, left + dx : right + dx])


@jit_parallel
def sum_colours(sums: Image, image: Image, mesh: Plane) -> None:
    """sums (SUMS, H, W) over 3 x 3 pixels of the same mesh."""
    height, width = mesh.shape
    for number in numba.prange(height):
        row = np.int64(number)
        space = np.empty(width, np.float32)
        sums[:, row] = 0
        for dx, dy, left, right in window_taps(row, 1, 1, height, width):
            same = space[left:right]
            compare(same, mesh[row, left:right], mesh[row + dy, left + dx : right + dx])
            for c in range(3):
                add_product(sums[c, row, left:right], same, image[c, row + dy, left + dx : right + dx])
            there = triple(image, row + dy, left + dx, right + dx)
            add_luminances(sums[3, row, left:right], sums[4, row, left:right], same, there)
            add_line(sums[5, row, left:right], same)


@jit_parallel
def average(mean_3x3: Image, mean_9x9: Image, deviation: Plane, sums_3x3: Image, mesh: Plane) -> None:
    """Means (3, H, W) and relative deviation (H, W) from the sums (SUMS, H, W) over 3 x 3 pixels."""
    height, width = mesh.shape
    for row in numba.prange(height):
        y = np.int64(row)
        sums = np.empty((SUMS, 1, width), np.float32)
        sum_row(sums, 0, sums_3x3, mesh, y, 3)
        for c in range(3):
            divide_line(mean_3x3[c, y], sums_3x3[c, y], sums_3x3[5, y])
            divide_line(mean_9x9[c, y], sums[c, 0], sums[5, 0])
        set_relative_deviation(deviation[y], sums[3, 0], sums[4, 0], sums[5, 0])


@jit_parallel
def sum_taps(sums: Image, image: Image, mesh: Plane, step: int) -> None:
    for row in numba.prange(len(mesh)):
        sum_row(sums, np.int64(row), image, mesh, np.int64(row), step)


def mesh_sums(image: Tensor, mesh_id: Tensor, step: int) -> Tensor:
    sums = torch.empty_like(image, memory_format=torch.contiguous_format)
    run_items(sum_taps, [sums], [image, mesh_id[:, 0]], step)
    return sums


def mesh_means(image: Tensor, mesh_id: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    mean_3x3 = torch.empty_like(image, memory_format=torch.contiguous_format)
    mean_9x9 = torch.empty_like(mean_3x3)
    deviation = torch.empty_like(mesh_id, memory_format=torch.contiguous_format)
    sums = image.new_empty(len(image), SUMS, *image.shape[2:])
    run_items(sum_colours, [sums], [image, mesh_id[:, 0]])
    run_items(average, [mean_3x3, mean_9x9, deviation[:, 0]], [sums, mesh_id[:, 0]])
    return mean_3x3, mean_9x9, deviation
