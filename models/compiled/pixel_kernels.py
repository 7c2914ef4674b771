"""models.networks.pixel_kernels for the CPU: rows in parallel, each with its logits in a core's cache."""

import math

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.compiled.arrays import Image, Plane, Row, Rows, f32
from models.compiled.exponential import exp
from models.compiled.jit import array, jit_in_order, jit_parallel
from models.compiled.lines import add_product, exclude, raise_line, window_taps

MIN_RELATIVE_LOGIT = np.float32(-87)  # to the largest: exp of less is denormal in float32, which is slow
PADDING = 16  # numbers; keeps the rows of a buffer from falling on the same set of the cache


@jit_in_order
def to_float32(row: Rows, logits: NDArray[np.float32 | np.int16], bfloat: bool) -> None:
    """row (taps, W) from logits of float32, or of the bits of bfloat16, which are the upper half of a float32."""
    for x in range(logits.shape[1]):
        for tap in range(logits.shape[0]):
            if bfloat:
                row[tap, x] = np.int32(np.int32(logits[tap, x]) << np.int32(16)).view(np.float32)
            else:
                row[tap, x] = logits[tap, x]


@jit_in_order
def to_weights(logits: Row, top: Row, total: Row) -> None:
    """In place, weights exp(logit - top); total += weights."""
    for x in range(top.size):
        weight = exp(max(logits[x] - top[x], MIN_RELATIVE_LOGIT))
        logits[x] = weight if logits[x] > f32(-np.inf) else f32(0)
        total[x] += logits[x]


@jit_parallel
def apply_to_image(
    output: Image, image: Image, surface: Plane, logits: NDArray[np.float32 | np.int16], size: int, bfloat: bool
) -> None:
    channels, height, width = image.shape
    radius = size // 2
    for number in numba.prange(height):
        y = np.int64(number)
        row = np.empty((size * size, width + PADDING), np.float32)
        top = np.full(width, f32(-np.inf))
        total = np.zeros(width, np.float32)
        sums = np.zeros((channels, width), np.float32)
        to_float32(row, logits[:, y], bfloat)
        for dx, dy, low, high in window_taps(y, radius, 1, height, width):
            line = row[(dy + radius) * size + dx + radius, low:high]
            exclude(line, surface[y + dy, low + dx : high + dx], f32(-np.inf))
            raise_line(top[low:high], line)
        for dx, dy, low, high in window_taps(y, radius, 1, height, width):
            weight = row[(dy + radius) * size + dx + radius, low:high]
            to_weights(weight, top[low:high], total[low:high])
            for c in range(channels):
                add_product(sums[c, low:high], weight, image[c, y + dy, low + dx : high + dx])
        for c in range(channels):
            output[c, y] = sums[c] / np.maximum(total, f32(1))


def apply_kernels(image: Tensor, logits: Tensor, surface: Tensor | None = None) -> Tensor:
    """See models.networks.pixel_kernels.apply_kernels; logits are read in place, bfloat16 without a copy."""
    output = torch.empty_like(image, memory_format=torch.contiguous_format)
    surface = torch.ones_like(image[:, :1]) if surface is None else surface
    bfloat = logits.dtype == torch.bfloat16
    bits = logits.view(torch.int16) if bfloat else logits.float()
    for item in range(len(image)):
        values = bits[item].detach().numpy()
        images = array(image[item]), array(surface[item, 0])
        apply_to_image(output[item].numpy(), *images, values, math.isqrt(logits.shape[1]), bfloat)
    return output
