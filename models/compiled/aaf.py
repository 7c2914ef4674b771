"""models.filters.aaf for the CPU: rows in parallel, every loop along them vectorised."""

import math

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.arrays import Image, Index, Row, Signals, f32
from models.compiled.exponential import exp
from models.compiled.jit import jit_in_any_order, jit_parallel, run_items
from models.compiled.lines import add_line, add_product, columns_with_tap, divide_line, triple_of_lines

DIFFUSE_BAND = 2.8  # band limit of what diffuse surfaces reflect, times the distance of that
MAX_REACH = 50  # px
TRUNCATION = 8**0.5  # standard deviations at which Gaussians end
COSINE_OF_5_DEGREES = math.cos(math.radians(5))  # of normals that are filtered together, at most
MAX_GAUSSIAN_EXPONENT = np.float32(TRUNCATION**2 / 2)
NEAR = np.float32(2 * DIFFUSE_BAND)


@jit_in_any_order
def measure(distance: Row, along: Row, geometry: Image, row: Index, left: Index, dx: Index, dy: Index) -> None:
    """Squared distances |d|² (n) of n pixels of a row to their taps, and |d|² - (d · n)² in the plane of the surface.

    geometry (6, H, W): positions, unit normals n. Distances are infinite where normals differ.
    """
    right = left + distance.size
    to = row + dy
    x, y, z = geometry[0, row, left:right], geometry[1, row, left:right], geometry[2, row, left:right]
    n_x, n_y, n_z = geometry[3, row, left:right], geometry[4, row, left:right], geometry[5, row, left:right]
    left += dx
    right += dx
    to_x, to_y, to_z = geometry[0, to, left:right], geometry[1, to, left:right], geometry[2, to, left:right]
    m_x, m_y, m_z = geometry[3, to, left:right], geometry[4, to, left:right], geometry[5, to, left:right]
    for i in range(distance.size):
        a = to_x[i] - x[i]
        b = to_y[i] - y[i]
        c = to_z[i] - z[i]
        squared = a * a + b * b + c * c
        off = a * n_x[i] + b * n_y[i] + c * n_z[i]
        same = n_x[i] * m_x[i] + n_y[i] * m_y[i] + n_z[i] * m_z[i] > f32(COSINE_OF_5_DEGREES)
        distance[i] = squared if same else f32(np.inf)
        along[i] = max(squared - off * off, f32(0))


@jit_in_any_order
def weigh(weight: Row, distance: Row, along: Row, width: Row, max_width: Row) -> None:
    """models.filters.aaf.gaussian_weight (n)."""
    for i in range(weight.size):
        narrower = min(width[i], max_width[i])
        exponent = f32(0.5) * along[i] / (narrower * narrower)
        reached = distance[i] < NEAR * NEAR * narrower * narrower and exponent <= MAX_GAUSSIAN_EXPONENT
        weight[i] = exp(-min(exponent, MAX_GAUSSIAN_EXPONENT)) if reached else f32(0)


@jit_parallel
def filter_image(out: Signals, image: Signals, width: Image, max_width: Image, geometry: Image, down: bool) -> None:
    """out (S, 3, H, W), a copy of the image, becomes the filtered one; width and max_width are (S, H, W)."""
    signals, _, height, columns = image.shape
    for number in numba.prange(height):
        row = np.int64(number)
        totals = np.ones((signals, columns), np.float32)
        space = np.empty((3, columns), np.float32)
        for step in range(-MAX_REACH, MAX_REACH + 1):
            dx, dy = (0, step) if down else (step, 0)
            left, right = columns_with_tap(row, dx, dy, height, columns)
            if step == 0 or left >= right:
                continue
            distance, along, weight = triple_of_lines(space, 0, right - left)
            measure(distance, along, geometry, row, left, dx, dy)
            for s in range(signals):
                here, there = width[s, row, left:right], max_width[s, row + dy, left + dx : right + dx]
                weigh(weight, distance, along, here, there)
                add_line(totals[s, left:right], weight)
                for c in range(3):
                    add_product(out[s, c, row, left:right], weight, image[s, c, row + dy, left + dx : right + dx])
        for s in range(signals):
            for c in range(3):
                divide_line(out[s, c, row], out[s, c, row], totals[s])


def filter_lines(image: Tensor, width: Tensor, max_width: Tensor, geometry: Tensor, down: bool) -> Tensor:
    out = image.clone(memory_format=torch.contiguous_format)
    run_items(filter_image, [out], [image, width[:, :, 0], max_width[:, :, 0], geometry[:, 0]], down)
    return out
