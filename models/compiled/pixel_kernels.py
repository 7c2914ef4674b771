"""models.networks.pixel_kernels for the processor: rows in parallel, each with its logits in a core's cache."""

import math
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.exponential import exp
from models.compiled.jit import array, jit_in_order, jit_parallel, jit_with_memory, plane_or_empty

MIN_RELATIVE_LOGIT = np.float32(-87)  # less than the largest: exp of less is denormal in float32, which is slow
NEVER = np.float32(-np.inf)  # logit of a tap that shows no surface
ONE_LINE = 16  # numbers; keeps the rows of a buffer from falling on the same set of the cache


@jit_in_order
def to_float32(row: Any, logits: Any, bfloat: bool) -> None:
    """row (taps, W) from logits of float32, or of the bits of bfloat16, which are the upper half of a float32."""
    if bfloat:
        for x in range(logits.shape[1]):
            for tap in range(logits.shape[0]):
                row[tap, x] = np.int32(np.int32(logits[tap, x]) << np.int32(16)).view(np.float32)
    else:
        for x in range(logits.shape[1]):
            for tap in range(logits.shape[0]):
                row[tap, x] = logits[tap, x]


@jit_in_order
def leave_out(logits: Any, surface: Any) -> None:
    for x in range(surface.size):
        logits[x] = logits[x] if surface[x] > 0 else NEVER


@jit_in_order
def raise_top(top: Any, logits: Any) -> None:
    for x in range(top.size):
        top[x] = max(top[x], logits[x])


@jit_in_order
def to_weights(logits: Any, top: Any, total: Any) -> None:
    """In place, weights relative to the largest logit; total += weights."""
    for x in range(top.size):
        weight = exp(max(logits[x] - top[x], MIN_RELATIVE_LOGIT))
        logits[x] = weight if logits[x] > NEVER else np.float32(0)
        total[x] += logits[x]


@jit_in_order
def add_weighted(line: Any, weight: Any, values: Any) -> None:
    for x in range(line.size):
        line[x] += weight[x] * values[x]


@jit_with_memory
def apply_to_row(output: Any, image: Any, surface: Any, row: Any, y: Any, size: int) -> None:
    """Row y of output, filtered by the softmax of row (size², W + ONE_LINE), whose contents are lost.

    surface (H, W) is empty where all pixels count.

    Slices are taken where they can be seen to be contiguous: else no loop would be vectorised.
    """
    channels, height, width = image.shape
    radius = size // 2
    top = np.full(width, NEVER)
    total = np.zeros(width, np.float32)
    sums = np.zeros((channels, width), np.float32)
    for gather in (False, True):
        for dy in range(max(-radius, -y), min(radius + 1, height - y)):
            for dx in range(max(-radius, 1 - width), min(radius + 1, width)):
                low = max(0, -dx)
                high = min(width, width - dx)
                logits = row[(dy + radius) * size + dx + radius, low:high]
                if not gather:
                    if surface.size > 0:
                        leave_out(logits, surface[y + dy, low + dx : high + dx])
                    raise_top(top[low:high], logits)
                    continue
                to_weights(logits, top[low:high], total[low:high])
                for c in range(channels):
                    add_weighted(sums[c, low:high], logits, image[c, y + dy, low + dx : high + dx])
    for c in range(channels):
        output[c, y] = sums[c] / np.maximum(total, np.float32(1))


@jit_parallel
def apply_to_image(output: Any, image: Any, surface: Any, logits: Any, size: int, bfloat: bool) -> None:
    _, height, width = image.shape
    for y in numba.prange(height):
        row = np.empty((size * size, width + ONE_LINE), np.float32)
        to_float32(row, logits[:, y], bfloat)
        apply_to_row(output, image, surface, row, np.int64(y), size)


def apply_kernels(image: Tensor, logits: Tensor, surface: Tensor | None = None) -> Tensor:
    """See models.networks.pixel_kernels.apply_kernels; logits are read in place, bfloat16 without a copy."""
    output = torch.empty_like(image, memory_format=torch.contiguous_format)
    bfloat = logits.dtype == torch.bfloat16
    bits = logits.view(torch.int16) if bfloat else logits.float()
    for item in range(len(image)):
        values = bits[item].detach().numpy()
        images = array(image[item]), plane_or_empty(surface, item)
        apply_to_image(output[item].numpy(), *images, values, math.isqrt(logits.shape[1]), bfloat)
    return output
