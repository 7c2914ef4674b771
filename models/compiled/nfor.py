"""models.filters.nfor for the processor: every loop along a row is vectorised."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models import parameters
from models.compiled.eaw import columns_with_tap, decay
from models.compiled.jit import array, jit_in_any_order, jit_parallel, jit_with_memory
from models.compiled.lines import add_line, add_product
from models.parameters import REACH, RIDGE, WINDOW

ZERO = np.float32(0)
ONE = np.float32(1)
EPSILON = np.float32(parameters.EPSILON_L)
LARGEST_DISTANCE = np.float32(parameters.LARGEST_DISTANCE)
FARTHEST = np.float32(parameters.FARTHEST)
COORDINATES = 3  # 1, x and y: what a model is linear in beside features
BLOCK = 64  # px; so many are fitted together, and their sums stay in the first cache


# --- Distances of patches ---------------------------------------------------------------------------------------------


@jit_in_any_order
def add_distances(apart: Any, here: Any, there: Any, noise: Any, other_noise: Any) -> None:
    """apart (n) += a third of one colour's distances, of pixels `here` to those `there`."""
    for x in range(apart.size):
        off = (here[x] - there[x]) * (here[x] - there[x]) - (noise[x] + min(noise[x], other_noise[x]))
        apart[x] += min(off / (EPSILON + noise[x] + other_noise[x]), LARGEST_DISTANCE) * (ONE / np.float32(3))


@jit_in_any_order
def keep_where_both(apart: Any, both: Any, here: Any, there: Any) -> None:
    for x in range(apart.size):
        both[x] = here[x] * there[x]
        apart[x] *= both[x]


@jit_in_any_order
def divide_or_farthest(out: Any, total: Any, count: Any, both: Any) -> None:
    for x in range(out.size):
        out[x] = max(total[x] / max(count[x], ONE), ZERO) if both[x] > ZERO else FARTHEST


@jit_with_memory
def box_sums(image: Any, radius: int) -> Any:
    """Sums over windows of (2 radius + 1)² pixels of an image (H, W)."""
    height, width = image.shape
    along = np.zeros_like(image)
    sums = np.zeros_like(image)
    for y in range(height):
        for d in range(-radius, radius + 1):
            left = max(0, -d)
            right = min(width, width - d)
            if left < right:
                add_line(along[y, left:right], image[y, left + d : right + d])
    for y in range(height):
        for to in range(max(0, y - radius), min(height, y + radius + 1)):
            add_line(sums[y], along[to])
    return sums


@jit_parallel
def measure_patches(out: Any, guide: Any, variance: Any, surface: Any, radius: int) -> None:
    """out (WINDOW², H, W) from guide and variance (3, H, W), surface (H, W)."""
    height, width = surface.shape
    for number in numba.prange(len(out)):
        tap: Any = np.int64(number)
        dy = tap // WINDOW - REACH
        dx = tap % WINDOW - REACH
        apart = np.zeros((height, width), np.float32)
        both = np.zeros((height, width), np.float32)
        for y in range(height):
            left, right = columns_with_tap(y, dx, dy, height, width)
            if left < right:
                there = slice(left + dx, right + dx)
                line = apart[y, left:right]
                for c in range(3):
                    noise = variance[c, y, left:right]
                    add_distances(
                        line, guide[c, y, left:right], guide[c, y + dy, there], noise, variance[c, y + dy, there]
                    )
                keep_where_both(line, both[y, left:right], surface[y, left:right], surface[y + dy, there])
        total = box_sums(apart, radius)
        count = box_sums(both, radius)
        for y in range(height):
            divide_or_farthest(out[tap, y], total[y], count[y], both[y])


def patch_distances(guide: Tensor, variance: Tensor, surface: Tensor, radius: int) -> Tensor:
    """See models.filters.nfor.patch_distances."""
    batch, _, height, width = guide.shape
    out = torch.empty(batch, WINDOW**2, height, width)
    for item in range(batch):
        images = array(guide[item]), array(variance[item]), array(surface[item, 0])
        measure_patches(out[item].numpy(), *images, radius)
    return out


# --- NL-means ---------------------------------------------------------------------------------------------------------


@jit_in_any_order
def weigh(weight: Any, distance: Any, sharpness: Any) -> None:
    for x in range(weight.size):
        weight[x] = decay(distance[x] * sharpness)


@jit_in_any_order
def divide(out: Any, sums: Any, total: Any) -> None:
    """A pixel's weight for itself is 1, so that no sum of weights is below it but off surfaces, where it is 0."""
    for x in range(out.size):
        out[x] = sums[x] / max(total[x], ONE)


@jit_parallel
def average_similar(out: Any, image: Any, distances: Any, sharpness: Any) -> None:
    """out (C, H, W)."""
    channels, height, width = image.shape
    for number in numba.prange(height):
        y: Any = np.int64(number)
        sums = np.zeros((channels, width), np.float32)
        total = np.zeros(width, np.float32)
        space = np.empty(width, np.float32)
        for tap in range(WINDOW**2):
            dy = tap // WINDOW - REACH
            dx = tap % WINDOW - REACH
            left, right = columns_with_tap(y, dx, dy, height, width)
            if left < right:
                weight = space[: right - left]
                weigh(weight, distances[tap, y, left:right], sharpness)
                add_line(total[left:right], weight)
                for c in range(channels):
                    add_product(sums[c, left:right], weight, image[c, y + dy, left + dx : right + dx])
        for c in range(channels):
            divide(out[c, y], sums[c], total)


def nl_means(image: Tensor, distances: Tensor, bandwidth: float) -> Tensor:
    """See models.filters.nfor.nl_means."""
    out = torch.empty_like(image, memory_format=torch.contiguous_format)
    for item in range(len(image)):
        average_similar(out[item].numpy(), array(image[item]), array(distances[item]), np.float32(bandwidth**-2))
    return out


# --- Regression -------------------------------------------------------------------------------------------------------


@jit_in_any_order
def subtract(line: Any, one: Any, other: Any) -> None:
    for x in range(line.size):
        line[x] = one[x] - other[x]


@jit_in_any_order
def multiply(line: Any, one: Any, other: Any) -> None:
    for x in range(line.size):
        line[x] = one[x] * other[x]


@jit_in_any_order
def add_outer(moments: Any, products: Any, regressors: Any, weight: Any, colours: Any) -> None:
    """Add a tap's part to the sums of w z zᵀ, of which the lower triangle is kept, and w z yᵀ."""
    count = len(regressors)
    for i in range(count):
        multiply(products, weight, regressors[i])
        for j in range(i + 1):
            add_product(moments[i, j], products, regressors[j])
        for c in range(3):
            add_product(moments[i, count + c], products, colours[c])


@jit_in_any_order
def solve(matrix: Any) -> None:
    """Solve in place, by Cholesky's decomposition.

    matrix (n, n + 3): a positive one, of which the lower triangle is given, and right sides that become solutions.
    """
    n, columns = matrix.shape
    for i in range(n):
        for j in range(i + 1):
            value = matrix[i, j]
            for k in range(j):
                value -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(value) if i == j else value / matrix[j, j]
    for c in range(n, columns):
        for i in range(n):
            value = matrix[i, c]
            for k in range(i):
                value -= matrix[i, k] * matrix[k, c]
            matrix[i, c] = value / matrix[i, i]
        for back in range(n):
            i = n - 1 - back
            value = matrix[i, c]
            for k in range(i + 1, n):
                value -= matrix[k, i] * matrix[k, c]
            matrix[i, c] = value / matrix[i, i]


@jit_with_memory
def fit_block(
    models: Any, y: int, first: int, last: int, image: Any, features: Any, distances: Any, sharpness: Any
) -> None:
    """models (n, 3, H, W) of the pixels `first` to `last` - 1 of a row."""
    count, height, width = features.shape
    n = COORDINATES + count
    moments = np.zeros((n, n + 3, BLOCK), np.float64)
    regressors = np.ones((n, BLOCK), np.float32)
    weights = np.empty(BLOCK, np.float32)
    products = np.empty(BLOCK, np.float32)
    for tap in range(WINDOW**2):
        dy = tap // WINDOW - REACH
        dx = tap % WINDOW - REACH
        inside, outside = columns_with_tap(y, dx, dy, height, width)
        left = max(inside, first)
        right = min(outside, last)
        if left >= right:
            continue
        here = slice(left - first, right - first)
        there = slice(left + dx, right + dx)
        weigh(weights[here], distances[tap, y, left:right], sharpness)
        regressors[1] = np.float32(dx / REACH)
        regressors[2] = np.float32(dy / REACH)
        for f in range(count):
            subtract(regressors[COORDINATES + f, here], features[f, y + dy, there], features[f, y, left:right])
        add_outer(moments[:, :, here], products[here], regressors[:, here], weights[here], image[:, y + dy, there])
    matrix = np.empty((n, n + 3), np.float64)
    for x in range(first, last):
        matrix[:] = moments[:, :, x - first]
        matrix[0, 0] = max(matrix[0, 0], 1)
        for i in range(1, n):
            matrix[i, i] += RIDGE * matrix[0, 0]
        solve(matrix)
        models[:, :, y, x] = matrix[:, n:]


@jit_parallel
def fit_image(models: Any, image: Any, features: Any, distances: Any, sharpness: Any) -> None:
    _, height, width = image.shape
    for number in numba.prange(height):
        y: Any = np.int64(number)
        for first in range(0, width, BLOCK):
            fit_block(models, y, first, min(first + BLOCK, width), image, features, distances, sharpness)


@jit_in_any_order
def predict(line: Any, models: Any, regressors: Any, c: int, row: int, low: int, high: int) -> None:
    """line (n): a colour as the models of the pixels `low` to `high` - 1 of a row predict it."""
    multiply(line, models[0, c, row, low:high], regressors[0])
    for i in range(1, len(regressors)):
        add_product(line, models[i, c, row, low:high], regressors[i])


@jit_parallel
def predict_image(out: Any, models: Any, features: Any, distances: Any, sharpness: Any) -> None:
    """out (3, H, W): at each pixel the mean of what the models of all pixels around it predict."""
    count, height, width = features.shape
    for number in numba.prange(height):
        y: Any = np.int64(number)
        sums = np.zeros((3, width), np.float32)
        total = np.zeros(width, np.float32)
        regressors = np.ones((COORDINATES + count, width), np.float32)
        weights = np.empty(width, np.float32)
        predicted = np.empty(width, np.float32)
        for tap in range(WINDOW**2):
            dy = tap // WINDOW - REACH
            dx = tap % WINDOW - REACH
            left, right = columns_with_tap(y, -dx, -dy, height, width)  # the pixel is a tap of the model's
            if left >= right:
                continue
            n = right - left
            row = y - dy
            low = left - dx
            high = right - dx
            weigh(weights[:n], distances[tap, row, low:high], sharpness)
            regressors[1] = np.float32(dx / REACH)
            regressors[2] = np.float32(dy / REACH)
            for f in range(count):
                subtract(regressors[COORDINATES + f, :n], features[f, y, left:right], features[f, row, low:high])
            add_line(total[left:right], weights[:n])
            for c in range(3):
                predict(predicted[:n], models, regressors[:, :n], c, row, low, high)
                add_product(sums[c, left:right], weights[:n], predicted[:n])
        for c in range(3):
            divide(out[c, y], sums[c], total)


def regress(image: Tensor, features: Tensor, distances: Tensor, bandwidth: float) -> Tensor:
    """See models.filters.nfor.regress."""
    out = torch.empty_like(image, memory_format=torch.contiguous_format)
    height, width = image.shape[2:]
    models = np.empty((COORDINATES + features.shape[1], 3, height, width), np.float32)
    for item in range(len(image)):
        given = array(features[item]), array(distances[item]), np.float32(bandwidth**-2)
        fit_image(models, array(image[item]), *given)
        predict_image(out[item].numpy(), models, *given)
    return out
