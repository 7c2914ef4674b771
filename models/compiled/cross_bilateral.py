"""The filter of models.networks.lbf for the CPU, with its gradient: rows in parallel, loops along them vectorised."""

from typing import TYPE_CHECKING, NamedTuple

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.affinity import pull_weights, scale_gradient
from models.compiled.arrays import Image, Index, Row, Rows, f32
from models.compiled.exponential import MIN_EXPONENT, exp
from models.compiled.jit import array, jit_in_any_order, jit_parallel
from models.compiled.lines import add_line, add_product, add_square, normalise, scale_line, window_taps
from models.operators import MIN_DIVISOR

if TYPE_CHECKING:
    from models.networks.lbf import Pixels

FILTER_RADIUS = 27  # px: windows of 55 x 55
FEATURE_GROUPS = (3, 3, 3, 1, 1)  # channels of each feature: position, normal, albedo, roughness, visibility
COLOUR_SHARPNESS = 1 / (2 * 7**2)  # 1 / 2 β²
MAX_EXPONENT = -MIN_EXPONENT
GROUP_COUNT = len(FEATURE_GROUPS)
FIRST_OF_GROUP = tuple(np.cumsum((0, *FEATURE_GROUPS)).tolist())  # channel of each group, and beyond the last


class Planes(NamedTuple):
    """What is filtered of one item, see models.networks.lbf."""

    image: Image
    variance: Image
    features: Image
    surface: Image
    sharpness: Image


@jit_in_any_order
def add_colour_distance(exponent: Row, here: Row, there: Row, variance: Row, variance_there: Row) -> None:
    for x in range(exponent.size):
        off = there[x] - here[x]
        noise = f32(MIN_DIVISOR) + variance[x] + variance_there[x]
        exponent[x] += f32(COLOUR_SHARPNESS) * (off * off / noise)


@jit_in_any_order
def decay_where(weight: Row, exponent: Row, surface: Row) -> None:
    for x in range(weight.size):
        weight[x] = exp(-min(exponent[x], f32(MAX_EXPONENT))) * surface[x]


@jit_in_any_order
def weigh_tap(
    weight: Row, exponent: Row, distances: Rows, planes: Planes, row: Index, left: Index, dx: Index, dy: Index
) -> None:
    """weight, exponent (n) and distances (1 + GROUP_COUNT, n) of n pixels of a row, from `left` on, to their taps."""
    here = slice(left, left + weight.size)
    there = slice(left + dx, left + dx + weight.size)
    image, variance, features, surface, sharpness = planes
    to = row + dy
    exponent[:] = f32(0)
    for c in range(3):
        noise, noise_there = variance[c, row, here], variance[c, to, there]
        add_colour_distance(exponent, image[c, row, here], image[c, to, there], noise, noise_there)
    distances[0][:] = f32(dy * dy + dx * dx)
    for group in range(GROUP_COUNT):
        distances[1 + group][:] = f32(0)
        for f in range(FIRST_OF_GROUP[group], FIRST_OF_GROUP[group + 1]):
            add_square(distances[1 + group], features[f, row, here], features[f, to, there])
    for s in range(1 + GROUP_COUNT):
        add_product(exponent, sharpness[s, row, here], distances[s])
    decay_where(weight, exponent, surface[0, to, there])


@jit_parallel
def filter_image(out: Image, total: Image, planes: Planes) -> None:
    """Add to out (3, H, W) and total (1, H, W), which are 0."""
    _, height, width = out.shape
    for number in numba.prange(height):
        row = np.int64(number)
        scratch = np.empty((3 + GROUP_COUNT, width), np.float32)
        for dx, dy, left, right in window_taps(row, FILTER_RADIUS, 1, height, width):
            lines = scratch[:, : right - left]
            weigh_tap(lines[0], lines[1], lines[2:], planes, row, left, dx, dy)
            add_line(total[0, row, left:right], lines[0])
            for c in range(3):
                add_product(out[c, row, left:right], lines[0], planes.image[c, row + dy, left + dx : right + dx])
        scale_line(total[0, row], planes.surface[0, row])
        for c in range(3):
            normalise(out[c, row], total[0, row])


def planes_of(pixels: "Pixels", sharpness: Tensor, item: int) -> Planes:
    return Planes(*(array(tensor[item]) for tensor in (*pixels, sharpness)))


def weighted_mean(pixels: "Pixels", sharpness: Tensor) -> tuple[Tensor, Tensor]:
    out = torch.zeros_like(pixels.image, memory_format=torch.contiguous_format)
    total = torch.zeros_like(pixels.surface, memory_format=torch.contiguous_format)
    for item in range(len(out)):
        filter_image(out[item].numpy(), total[item].numpy(), planes_of(pixels, sharpness, item))
    return out, total


# --- Gradient ---------------------------------------------------------------------------------------------------------


@jit_in_any_order
def pull_exponent(pull: Row, exponent: Row) -> None:
    """pull (n), of the weights times these, becomes the gradient of the exponent: 0 where that is clamped."""
    for x in range(pull.size):
        pull[x] = -pull[x] if exponent[x] < f32(MAX_EXPONENT) else f32(0)


@jit_parallel
def pull_image(pulled: Image, gradient: Image, out: Image, total: Image, planes: Planes) -> None:
    """Add to pulled (1 + GROUP_COUNT, H, W)."""
    _, height, width = out.shape
    for number in numba.prange(height):
        row = np.int64(number)
        scratch = np.empty((4 + GROUP_COUNT, width), np.float32)
        scaled = np.empty((3, width), np.float32)
        dots = np.zeros(width, np.float32)
        for c in range(3):
            scale_gradient(scaled[c], dots, gradient[c, row], out[c, row], total[0, row])
        for dx, dy, left, right in window_taps(row, FILTER_RADIUS, 1, height, width):
            lines = scratch[:, : right - left]
            weight, exponent, pull, distances = lines[0], lines[1], lines[2], lines[3:]
            weigh_tap(weight, exponent, distances, planes, row, left, dx, dy)
            pull[:] = f32(0)
            for c in range(3):
                add_product(pull, scaled[c, left:right], planes.image[c, row + dy, left + dx : right + dx])
            pull_weights(pull, weight, dots[left:right])
            pull_exponent(pull, exponent)
            for s in range(1 + GROUP_COUNT):
                add_product(pulled[s, row, left:right], pull, distances[s])


def pull_sharpness(gradient: Tensor, pixels: "Pixels", sharpness: Tensor, out: Tensor, total: Tensor) -> Tensor:
    pulled = torch.zeros_like(sharpness, memory_format=torch.contiguous_format)
    for item in range(len(pulled)):
        planes = planes_of(pixels, sharpness, item)
        pull_image(pulled[item].numpy(), array(gradient[item]), array(out[item]), array(total[item]), planes)
    return pulled
