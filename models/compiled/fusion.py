"""models.fusion for the processor: strips of rows, each within a core's cache, every loop along a row vectorised.

Loops run over rows that are sliced off as wholes: indices that are sums might be negative, which NumPy takes from the
end, and slices of several dimensions might have any stride. Neither is vectorised.
"""

import functools
from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from numba.np.ufunc.parallel import get_thread_id
from torch import Tensor

from models import parameters
from models.compiled.exponential import exp
from models.compiled.jit import array, jit_in_any_order, jit_with_memory, plane_or_empty
from models.parameters import WINDOWS

THREAD_ROWS = 32  # rows that a thread fuses at once
SAFE_RANGE = np.float32(parameters.SAFE_RANGE)
LEAST_EXPONENT = np.float32(parameters.LEAST_EXPONENT)
OUTSIDE = np.float32(parameters.OUTSIDE)
LEAST_WEIGHT = np.float32(parameters.LEAST_WEIGHT)


@jit_in_any_order
def column_sums(columns: Any, margin: int, source: Any, first: int, last: int) -> None:
    """columns (4, W + 2 margin), within its margins, = sum of rows first to last - 1 of source (4, rows, W)."""
    width = source.shape[2]
    for c in range(4):
        row = columns[c][margin : margin + width]
        top = source[c, first]
        for x in range(width):
            row[x] = top[x]
        for y in range(first + 1, last):
            line = source[c, y]
            for x in range(width):
                row[x] += line[x]


@jit_in_any_order
def row_sums(total: Any, columns: Any, radius: int) -> None:
    """total (4, W) = sums of 2 radius + 1 neighbours in columns (4, W + 2 radius)."""
    for c in range(4):
        row = total[c]
        line = columns[c]
        width = row.size
        for x in range(width):
            row[x] = line[x]
        for tap in range(1, 2 * radius + 1):
            shifted = line[tap : tap + width]
            for x in range(width):
                row[x] += shifted[x]


@jit_in_any_order
def mix(fused: Any, y: int, total: Any, share: Any) -> None:
    """Row y of fused (3, H, W) += share (W) times the ratio of sums in total (4, W)."""
    weight = total[3]
    for c in range(3):
        row = fused[c, y]
        sums = total[c]
        for x in range(share.size):
            row[x] += share[x] * sums[x] / max(weight[x], LEAST_WEIGHT)


@jit_in_any_order
def copy_rows(rows: Any, source: Any) -> None:
    """rows (n, W) = source (n, W), of any strides."""
    for y in range(rows.shape[0]):
        line = rows[y]
        for x in range(line.size):
            line[x] = source[y, x]


@jit_in_any_order
def leave_out(logits: Any, surface: Any) -> None:
    """logits (n, W) become OUTSIDE where surface (n, W) is 0."""
    for y in range(logits.shape[0]):
        line = logits[y]
        there = surface[y]
        for x in range(line.size):
            line[x] = line[x] if there[x] > 0 else OUTSIDE


@jit_in_any_order
def lowest(logits: Any, high: Any) -> Any:
    """The lowest of logits (n, W) that are not OUTSIDE, at most `high`."""
    low = high
    for y in range(logits.shape[0]):
        line = logits[y]
        for x in range(line.size):
            entry = line[x] if line[x] > OUTSIDE else high
            low = entry if entry < low else low
    return low


@jit_with_memory
def softmax(shares: Any, y: int) -> None:
    """Row y of shares (M, rows, W) becomes its softmax over M."""
    count, _, width = shares.shape
    top = shares[0, y].copy()
    total = np.zeros(width, np.float32)
    for i in range(1, count):
        share = shares[i, y]
        for x in range(width):
            top[x] = share[x] if share[x] > top[x] else top[x]
    for i in range(count):
        share = shares[i, y]
        for x in range(width):
            exponent = share[x] - top[x]
            share[x] = exp(exponent if exponent > LEAST_EXPONENT else LEAST_EXPONENT)
            total[x] += share[x]
    for i in range(count):
        share = shares[i, y]
        for x in range(width):
            share[x] /= total[x]


@jit_with_memory
def filter_strip(
    fused: Any, image: Any, logits: Any, shift: Any, shares: Any, radius: int, start: int, low: int, weighted: Any
) -> None:
    """Add a window's share to a strip of rows from `start` on.

    `fused` and `image` (3, H, W) are whole; `logits` (rows, W), from row `low` on, cover the windows of the strip and
    lie within SAFE_RANGE around `shift`, or OUTSIDE; `shares` (strip, W); `weighted` (5, rows or more, W) is scratch.
    """
    height, width = image.shape[1:]
    stop = start + len(shares)
    for y in range(len(logits)):
        line = weighted[3, y]
        entry = logits[y]
        for x in range(width):
            line[x] = exp(max(entry[x] - shift, LEAST_EXPONENT)) if entry[x] > OUTSIDE else np.float32(0)
        for c in range(3):
            product = weighted[c, y]
            pixel = image[c, low + y]
            for x in range(width):
                product[x] = pixel[x] * line[x]
    columns = np.zeros((4, width + 2 * radius), np.float32)
    total = np.empty((4, width), np.float32)
    for y in range(start, stop):
        column_sums(columns, radius, weighted, max(y - radius, 0) - low, min(y + radius + 1, height) - low)
        row_sums(total, columns, radius)
        mix(fused, y, total, shares[y - start])


@jit_with_memory
def gather_in_steps(tops: Any, totals: Any, margin: int, entries: Any, values: Any, taps: int) -> None:
    """Largest entry (taps, W), and sums of exp(entry - largest) * value (4, taps, W), into tops and totals.

    These have `margin` entries more on both sides: tops (W + 2 margin), totals (4, W + 2 margin).
    """
    width = entries.shape[1]
    top = tops[margin : margin + width]
    weight = np.empty(width, np.float32)
    top[:] = entries[0]
    for tap in range(1, taps):
        entry = entries[tap]
        for x in range(width):
            top[x] = entry[x] if entry[x] > top[x] else top[x]
    totals[:] = 0
    for tap in range(taps):
        entry = entries[tap]
        for x in range(width):
            exponent = entry[x] - top[x]
            exponent = exponent if exponent > LEAST_EXPONENT else LEAST_EXPONENT
            weight[x] = exp(exponent) if entry[x] > OUTSIDE else np.float32(0)
        for c in range(4):
            total = totals[c][margin : margin + width]
            value = values[c, tap]
            for x in range(width):
                total[x] += weight[x] * value[x]


@jit_with_memory
def filter_strip_in_steps(fused: Any, image: Any, logits: Any, shares: Any, radius: int, start: int, low: int) -> None:
    """The same for any finite logits: relative to the largest of every window, columns first, then rows."""
    height, width = image.shape[1:]
    taps = 2 * radius + 1
    entries = np.empty((taps, width), np.float32)
    values = np.zeros((4, taps, width), np.float32)
    top = np.empty(width, np.float32)
    tops = np.full(width + 2 * radius, OUTSIDE)
    total = np.empty((4, width), np.float32)
    totals = np.zeros((4, width + 2 * radius), np.float32)
    for y in range(start, start + len(shares)):
        first = max(y - radius, 0)
        last = min(y + radius + 1, height)
        for tap in range(last - first):
            entries[tap] = logits[first + tap - low]
            values[:3, tap] = image[:, first + tap]
            values[3, tap] = 1
        gather_in_steps(tops, totals, radius, entries, values, last - first)
        for tap in range(taps):
            entries[tap] = tops[tap : tap + width]
            values[:, tap] = totals[:, tap : tap + width]
        gather_in_steps(top, total, 0, entries, values, taps)
        mix(fused, y, total, shares[y - start])


def fuse_strips(
    fused: Any, image: Any, surface: Any, importance: Any, mixture: Any, windows: Any, weighted: Any, shares: Any
) -> None:
    """fused (3, H, W) += image (3, H, W) filtered, strips in parallel; surface (H, W) is empty where all pixels count.

    weighted (threads, 5, rows, W) and shares (threads, M, THREAD_ROWS, W) are scratch of the threads' own: memory that
    is allocated within the loop would be cleared anew for every strip.
    """
    height = image.shape[1]
    for strip in numba.prange((height + THREAD_ROWS - 1) // THREAD_ROWS):
        start = strip * THREAD_ROWS
        stop = min((strip + 1) * THREAD_ROWS, height)
        my_weighted = weighted[get_thread_id()]
        my_shares = shares[get_thread_id()]
        for i in range(windows.size):
            copy_rows(my_shares[i, : stop - start], mixture[i, start:stop])
        for y in range(stop - start):
            softmax(my_shares, y)
        for i in range(windows.size):
            radius = windows[i] // 2
            low = max(start - radius, 0)
            high = min(stop + radius, height)
            logits = my_weighted[4, : high - low]
            copy_rows(logits, importance[i, low:high])
            if surface.size > 0:
                leave_out(logits, surface[low:high])
            top = logits.max()
            bottom = lowest(logits, top)
            my_share = my_shares[i, : stop - start]
            if top - bottom <= SAFE_RANGE:
                shift = (bottom + top) / np.float32(2)
                filter_strip(fused, image, logits, shift, my_share, radius, start, low, my_weighted)
            else:
                filter_strip_in_steps(fused, image, logits, my_share, radius, start, low)


@functools.cache
def compiled_fuse_strips() -> Any:
    """`fuse_strips`, compiled once for maps of any strides. That takes seconds even from disk: not at import."""
    image = numba.float32[:, :, ::1]
    maps = numba.float32[:, :, :]
    scratch = numba.float32[:, :, :, ::1]
    signature = numba.void(image, image, numba.float32[:, ::1], maps, maps, numba.int64[::1], scratch, scratch)
    return numba.njit(signature, cache=True, parallel=True, error_model="numpy")(fuse_strips)


def fuse(
    image: Tensor,
    importance: Tensor,
    mixture: Tensor,
    windows: Sequence[int] = WINDOWS,
    surface: Tensor | None = None,
) -> Tensor:
    """See models.fusion.fuse. The maps are read as they lie in memory."""
    fused = torch.zeros_like(image, memory_format=torch.contiguous_format)
    threads = numba.get_num_threads()
    width = image.shape[-1]
    weighted = np.empty((threads, 5, THREAD_ROWS + max(windows), width), np.float32)
    shares = np.empty((threads, len(windows), THREAD_ROWS, width), np.float32)
    for item in range(len(image)):
        images = fused[item].numpy(), array(image[item]), plane_or_empty(surface, item)
        maps = importance[item].detach().float().numpy(), mixture[item].detach().float().numpy()
        compiled_fuse_strips()(*images, *maps, np.array(windows), weighted, shares)
    return fused


def fuse_on_gpu(
    image: Tensor,
    importance: Tensor,
    mixture: Tensor,
    windows: Sequence[int] = WINDOWS,
    surface: Tensor | None = None,
) -> Tensor:
    """The same for CUDA devices, by Triton, which is imported here because it takes long and is not everywhere."""
    from models.compiled.fusion_triton import fuse

    return fuse(image, importance, mixture, windows, surface)
