"""models.filters.bmfr for the CPU: blocks in parallel, each with its matrix in the cache, column by column."""

from typing import TypeAlias

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.arrays import Doubles, Image, Index, Plane
from models.compiled.jit import array, jit_in_any_order, jit_parallel, jit_with_memory

BLOCK_SIDE = 32  # px
REGRESSORS = 10  # 1, normal (3), position (3), its squares (3)
MIN_RELATIVE_EXTENT = 1e-3  # of a block's largest: positions along an axis of less are not stretched to [0, 1]
PIXELS = BLOCK_SIDE**2
COLUMNS = REGRESSORS + 3  # of the augmented matrix: features and colours
POSITION = 4  # the first column of positions
SQUARE = 7  # and of their squares
Images: TypeAlias = tuple[Image, Image, Image]  # of one item: irradiance, normal, depth (1, H, W)


@jit_in_any_order
def mirror(place: Index, size: int) -> Index:
    """The pixel at a place of an axis that is mirrored at both ends."""
    place %= 2 * size
    return min(place, 2 * size - 1 - place)


@jit_in_any_order
def dot(a: Doubles, b: Doubles) -> float:
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@jit_in_any_order
def add_multiple(a: Doubles, b: Doubles, factor: float) -> None:
    for i in range(a.size):
        a[i] += factor * b[i]


@jit_in_any_order
def gather_block(columns: Doubles, light: Doubles, images: Images, axes: Doubles, top: Index, left: Index) -> bool:
    """Fill columns (10, P), but positions unscaled, and light (3, P), with 0 off surfaces.

    The block begins at row `top` and column `left` of the image. Returns whether it shows any surface.
    """
    irradiance, normal, depth = images
    _, height, width = depth.shape
    count = 0.0
    for p in range(PIXELS):
        y = mirror(top + p // BLOCK_SIDE, height)
        x = mirror(left + p % BLOCK_SIDE, width)
        d = np.float64(depth[0, y, x])
        surface = d > 0
        columns[0, p] = 1.0 if surface else 0.0
        count += columns[0, p]
        for i in range(3):
            ray = axes[i, 0] * (x + 0.5) + axes[i, 1] * (y + 0.5) + axes[i, 2]
            columns[1 + i, p] = normal[i, y, x] if surface else 0.0
            columns[POSITION + i, p] = d * ray if surface else 0.0
            light[i, p] = irradiance[i, y, x] if surface else 0.0
    return count > 0


@jit_in_any_order
def begin_at_0(position: Doubles, surface: Doubles) -> float:
    """Shift the positions (P) of surfaces along an axis; returns their extent."""
    low = np.inf
    high = -np.inf
    for i in range(position.size):
        low = min(low, position[i] if surface[i] > 0 else np.inf)
        high = max(high, position[i] if surface[i] > 0 else -np.inf)
    for i in range(position.size):
        position[i] = position[i] - low if surface[i] > 0 else 0.0
    return high - low


@jit_in_any_order
def scale(position: Doubles, square: Doubles, factor: float) -> None:
    for i in range(position.size):
        position[i] *= factor
        square[i] = position[i] * position[i]


@jit_with_memory
def scale_positions(columns: Doubles) -> None:
    """Scale the positions among columns (10, P) to [0, 1], and square them."""
    extents = np.empty(3)
    for i in range(3):
        extents[i] = begin_at_0(columns[POSITION + i], columns[0])
    least = MIN_RELATIVE_EXTENT * extents.max()
    for i in range(3):
        extent = max(extents[i], least)
        scale(columns[POSITION + i], columns[SQUARE + i], 1 / extent if extent > 0 else 0.0)


@jit_in_any_order
def triangularise(matrix: Doubles) -> None:
    """Matrix (13, P), column after column: the first ten become R of a QR factorisation, by Householder reflections."""
    for k in range(REGRESSORS):
        v = matrix[k, k:]
        length = np.sqrt(dot(v, v))
        diagonal = -length if v[0] > 0 else length
        half = length * (length + abs(v[0]))  # of |v|² after the next line
        v[0] -= diagonal
        for j in range(k + 1, COLUMNS):
            add_multiple(matrix[j, k:], v, -dot(v, matrix[j, k:]) / half)
        v[0] = diagonal


@jit_in_any_order
def substitute(coefficients: Doubles, matrix: Doubles) -> None:
    """Coefficients (3, 10) of each colour, from the last feature to the first."""
    for c in range(3):
        for i in range(REGRESSORS - 1, -1, -1):
            value = matrix[REGRESSORS + c, i]
            for j in range(i + 1, REGRESSORS):
                value -= matrix[j, i] * coefficients[c, j]
            coefficients[c, i] = value / matrix[i, i]


@jit_in_any_order
def write_block(plane: Plane, values: Doubles, top: Index, left: Index) -> None:
    """The part of values (P) that lies in the image's plane (H, W)."""
    height, width = plane.shape
    for y in range(max(top, 0), min(top + BLOCK_SIDE, height)):
        row = (y - top) * BLOCK_SIDE - left
        for x in range(max(left, 0), min(left + BLOCK_SIDE, width)):
            plane[y, x] = values[row + x]


@jit_parallel
def regress_image(fitted: Image, images: Images, axes: Doubles, noise: Doubles, above: int, before: int) -> None:
    """fitted (3, H, W), by blocks of which the first begins `above` and `before` the image.

    Rays in the camera's frame are x axes[:, 0] + y axes[:, 1] + axes[:, 2]; noise (10, P) is added to the features.
    """
    _, height, width = fitted.shape
    down = (height + above + BLOCK_SIDE - 1) // BLOCK_SIDE
    across = (width + before + BLOCK_SIDE - 1) // BLOCK_SIDE
    for block in numba.prange(down * across):
        top = np.int64(block) // across * BLOCK_SIDE - above
        left = np.int64(block) % across * BLOCK_SIDE - before
        columns = np.empty((REGRESSORS, PIXELS))
        matrix = np.empty((COLUMNS, PIXELS))
        coefficients = np.empty((3, REGRESSORS))
        light = matrix[REGRESSORS:]
        if gather_block(columns, light, images, axes, top, left):
            scale_positions(columns)
            matrix[:REGRESSORS] = columns + noise
            triangularise(matrix)
            substitute(coefficients, matrix)
            for c in range(3):
                light[c] = 0.0
                for i in range(REGRESSORS):
                    add_multiple(light[c], columns[i], coefficients[c, i])
        for c in range(3):
            write_block(fitted[c], light[c], top, left)


def regress(
    irradiance: Tensor, normal: Tensor, depth: Tensor, axes: Tensor, noise: Tensor, offset: tuple[int, int]
) -> Tensor:
    fitted = torch.empty_like(irradiance, memory_format=torch.contiguous_format)
    doubles = noise.T.contiguous().numpy()
    for item in range(len(irradiance)):
        images = array(irradiance[item]), array(normal[item]), array(depth[item])
        regress_image(fitted[item].numpy(), images, axes[item].contiguous().numpy(), doubles, *offset)
    return fitted
