"""models.networks.cross_bilateral for the CPU, with its gradient: a row at a time, every loop along it vectorised."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.affinity import add_weighted, normalise, pull_weights, scale_gradient
from models.compiled.eaw import columns_with_tap
from models.compiled.exponential import MIN_EXPONENT, exp
from models.compiled.jit import array, jit_in_any_order, jit_parallel, jit_with_memory
from models.compiled.lines import add_product, fill_line, scale_line
from models.operators import MIN_DIVISOR

FILTER_RADIUS = 27  # px: windows of 55 x 55
FEATURE_GROUPS = (3, 3, 3, 1, 1)  # channels of each feature: position, normal, albedo, roughness, visibility
COLOUR_SHARPNESS = 1 / (2 * 7**2)  # 1 / 2 β²
MAX_EXPONENT = -MIN_EXPONENT
GROUP_COUNT = len(FEATURE_GROUPS)
if TYPE_CHECKING:
    from models.networks.cross_bilateral import Pixels

ZERO = np.float32(0)
FIRST = tuple(np.cumsum((0, *FEATURE_GROUPS)).tolist())  # channel of each group, and beyond the last


@jit_in_any_order
def add_apart(exponent: Any, here: Any, there: Any, variance: Any, variance_there: Any) -> None:
    for x in range(exponent.size):
        off = there[x] - here[x]
        exponent[x] += np.float32(COLOUR_SHARPNESS) * (
            off * off / (np.float32(MIN_DIVISOR) + variance[x] + variance_there[x])
        )


@jit_in_any_order
def add_square(distance: Any, here: Any, there: Any) -> None:
    for x in range(distance.size):
        distance[x] += (there[x] - here[x]) * (there[x] - here[x])


@jit_in_any_order
def decay_where(weight: Any, exponent: Any, surface: Any) -> None:
    for x in range(weight.size):
        weight[x] = exp(-min(exponent[x], np.float32(MAX_EXPONENT))) * surface[x]


class Planes(NamedTuple):
    """What a filter takes of one item: arrays (·, H, W), see models.networks.cross_bilateral."""

    image: Any
    variance: Any
    features: Any
    surface: Any
    sharpness: Any


@jit_in_any_order
def weigh_tap(weight: Any, exponent: Any, distances: Any, given: Any, row: Any, left: Any, dy: Any, dx: Any) -> None:
    """weight, exponent (n) and distances (1 + GROUP_COUNT, n) of n pixels of a row, from `left` on, to their taps."""
    here = slice(left, left + weight.size)
    there = slice(left + dx, left + dx + weight.size)
    image, variance, features, surface, sharpness = given
    fill_line(exponent, ZERO)
    for c in range(3):
        add_apart(
            exponent,
            image[c, row, here],
            image[c, row + dy, there],
            variance[c, row, here],
            variance[c, row + dy, there],
        )
    fill_line(distances[0], np.float32(dy * dy + dx * dx))
    for group in range(GROUP_COUNT):
        fill_line(distances[1 + group], ZERO)
        for f in range(FIRST[group], FIRST[group + 1]):
            add_square(distances[1 + group], features[f, row, here], features[f, row + dy, there])
    for s in range(1 + GROUP_COUNT):
        add_product(exponent, sharpness[s, row, here], distances[s])
    decay_where(weight, exponent, surface[0, row + dy, there])


@jit_with_memory
def filter_row(out: Any, total: Any, given: Any, row: Any) -> None:
    """A row of out (3, H, W) and total (1, H, W)."""
    height, width = given.surface.shape[1:]
    scratch = np.empty((3 + GROUP_COUNT, width), np.float32)
    out[:, row] = ZERO
    total[:, row] = ZERO
    for dy in range(-FILTER_RADIUS, FILTER_RADIUS + 1):
        for dx in range(-FILTER_RADIUS, FILTER_RADIUS + 1):
            left, right = columns_with_tap(row, dx, dy, height, width)
            if left >= right:
                continue
            lines = scratch[:, : right - left]
            weigh_tap(lines[0], lines[1], lines[2:], given, row, left, dy, dx)
            there = given.image[:, row + dy, left + dx : right + dx]
            mean = out[:, row, left:right]
            add_weighted(mean[0], mean[1], mean[2], total[0, row, left:right], lines[0], there[0], there[1], there[2])
    scale_line(total[0, row], given.surface[0, row])
    normalise(out[0, row], out[1, row], out[2, row], total[0, row])


@jit_parallel
def filter_image(out: Any, total: Any, given: Any) -> None:
    for row in numba.prange(out.shape[1]):
        filter_row(out, total, given, np.int64(row))


def planes(pixels: "Pixels", sharpness: Tensor, item: int) -> Planes:
    return Planes(*(array(tensor[item]) for tensor in (*pixels, sharpness)))


def weighted_mean(pixels: "Pixels", sharpness: Tensor) -> tuple[Tensor, Tensor]:
    """See models.networks.cross_bilateral.weighted_mean."""
    out = torch.empty_like(pixels.image, memory_format=torch.contiguous_format)
    total = torch.empty_like(pixels.surface, memory_format=torch.contiguous_format)
    for item in range(len(out)):
        filter_image(out[item].numpy(), total[item].numpy(), planes(pixels, sharpness, item))
    return out, total


# --- Gradient ---------------------------------------------------------------------------------------------------------


@jit_in_any_order
def drop_beyond(pull: Any, exponent: Any) -> None:
    """Where the weight is the least there is, it does not change."""
    for x in range(pull.size):
        pull[x] = pull[x] if exponent[x] < np.float32(MAX_EXPONENT) else ZERO


@jit_in_any_order
def subtract_product(line: Any, one: Any, other: Any) -> None:
    for x in range(line.size):
        line[x] -= one[x] * other[x]


@jit_with_memory
def pull_row(pulled: Any, gradient: Any, out: Any, total: Any, given: Any, row: Any) -> None:
    """A row of pulled (1 + GROUP_COUNT, H, W)."""
    height, width = given.surface.shape[1:]
    scratch = np.empty((4 + GROUP_COUNT, width), np.float32)
    scaled = np.empty((3, width), np.float32)
    dots = np.zeros(width, np.float32)
    pulled[:, row] = ZERO
    for c in range(3):
        scale_gradient(scaled[c], dots, gradient[c, row], out[c, row], total[0, row])
    for dy in range(-FILTER_RADIUS, FILTER_RADIUS + 1):
        for dx in range(-FILTER_RADIUS, FILTER_RADIUS + 1):
            left, right = columns_with_tap(row, dx, dy, height, width)
            if left >= right:
                continue
            lines = scratch[:, : right - left]
            weight, exponent, pull, distances = lines[0], lines[1], lines[2], lines[3:]
            weigh_tap(weight, exponent, distances, given, row, left, dy, dx)
            there = given.image[:, row + dy, left + dx : right + dx]
            here = scaled[:, left:right]
            pull_weights(pull, weight, here[0], here[1], here[2], dots[left:right], there[0], there[1], there[2])
            drop_beyond(pull, exponent)
            for s in range(1 + GROUP_COUNT):
                subtract_product(pulled[s, row, left:right], pull, distances[s])


@jit_parallel
def pull_image(pulled: Any, gradient: Any, out: Any, total: Any, given: Any) -> None:
    for row in numba.prange(out.shape[1]):
        pull_row(pulled, gradient, out, total, given, np.int64(row))


def pull_sharpness(gradient: Tensor, pixels: "Pixels", sharpness: Tensor, out: Tensor, total: Tensor) -> Tensor:
    """See models.networks.cross_bilateral.pull_sharpness."""
    pulled = torch.empty_like(sharpness, memory_format=torch.contiguous_format)
    for item in range(len(pulled)):
        given = planes(pixels, sharpness, item)
        pull_image(pulled[item].numpy(), array(gradient[item]), array(out[item]), array(total[item]), given)
    return pulled
