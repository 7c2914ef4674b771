"""models.fusion for the processor: strips of rows, each within a core's cache, every loop along a row vectorised."""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from numba.np.ufunc.parallel import get_thread_id
from torch import Tensor

from models.compiled import array, jit, threads
from models.compiled.exponential import exp

STRIP = 32  # rows
SAFE_RANGE = np.float32(80)  # see models.fusion
LEAST_EXPONENT = np.float32(-80)
OUTSIDE = np.float32(-1e30)

# Loops run over rows that are sliced off as wholes: indices that are sums might be negative, which NumPy takes from the
# end, and slices of several dimensions might have any stride. Neither is vectorised.


@jit
def column_sums(columns: Any, margin: int, source: Any, first: int, last: int) -> None:
    """columns (4, W + 2 margin), within its margins, = sum of rows first to last - 1 of source (4, rows, W)."""
    width = source.shape[2]
    for c in range(4):
        row = columns[c][margin : margin + width]
        row[:] = source[c, first]
        for y in range(first + 1, last):
            line = source[c, y]
            for x in range(width):
                row[x] += line[x]


@jit
def row_sums(total: Any, columns: Any, radius: int) -> None:
    """total (4, W) = sums of 2 radius + 1 neighbours in columns (4, W + 2 radius)."""
    for c in range(4):
        row, line = total[c], columns[c]
        width = row.size
        row[:] = line[:width]
        for tap in range(1, 2 * radius + 1):
            shifted = line[tap : tap + width]
            for x in range(width):
                row[x] += shifted[x]


@jit
def mix(fused: Any, y: int, total: Any, share: Any) -> None:
    """Row y of fused (3, H, W) += share (W) times the ratio of sums in total (4, W)."""
    weight = total[3]
    for c in range(3):
        row, sums = fused[c, y], total[c]
        for x in range(share.size):
            row[x] += share[x] * sums[x] / weight[x]


@jit
def unpack(planes: Any, maps: Any) -> None:
    """planes (rows, W) = maps (rows, W), of any strides."""
    for y in range(planes.shape[0]):
        line = planes[y]
        for x in range(line.size):
            line[x] = maps[y, x]


@jit
def softmax(shares: Any, y: int) -> None:
    """Row y of shares (M, rows, W) becomes its softmax over M."""
    count, _, width = shares.shape
    top, total = shares[0, y].copy(), np.zeros(width, np.float32)
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


@jit
def filter_strip(
    fused: Any, image: Any, logits: Any, shares: Any, radius: int, start: int, low: int, weighted: Any
) -> None:
    """Add a window's share to a strip of rows from `start` on.

    `fused` and `image` (3, H, W) are whole; `logits` (rows, W), from row `low` on, cover the windows of the strip
    and lie within SAFE_RANGE; `shares` (strip, W); `weighted` (5, rows or more, W) is scratch.
    """
    height, width = image.shape[1:]
    rows, stop = len(logits), start + len(shares)
    shift = (logits.min() + logits.max()) / np.float32(2)
    for y in range(rows):
        line, entry = weighted[3, y], logits[y]
        for x in range(width):
            line[x] = exp(entry[x] - shift)
        for c in range(3):
            product, pixel = weighted[c, y], image[c, low + y]
            for x in range(width):
                product[x] = pixel[x] * line[x]
    columns = np.zeros((4, width + 2 * radius), np.float32)
    total = np.empty((4, width), np.float32)
    for y in range(start, stop):
        column_sums(columns, radius, weighted, max(y - radius, 0) - low, min(y + radius + 1, height) - low)
        row_sums(total, columns, radius)
        mix(fused, y, total, shares[y - start])


@jit
def gather_in_steps(tops: Any, totals: Any, margin: int, entries: Any, values: Any, taps: int) -> None:
    """Largest entry (taps, W), and sums of exp(entry - largest) * value (4, taps, W), into tops and totals.

    These have `margin` entries more on both sides: tops (W + 2 margin), totals (4, W + 2 margin).
    """
    width = entries.shape[1]
    top, weight = tops[margin : margin + width], np.empty(width, np.float32)
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
            total, value = totals[c][margin : margin + width], values[c, tap]
            for x in range(width):
                total[x] += weight[x] * value[x]


@jit
def filter_strip_in_steps(fused: Any, image: Any, logits: Any, shares: Any, radius: int, start: int, low: int) -> None:
    """The same for any finite logits: relative to the largest of every window, columns first, then rows."""
    height, width = image.shape[1:]
    taps = 2 * radius + 1
    entries = np.empty((taps, width), np.float32)
    values = np.zeros((4, taps, width), np.float32)
    top, tops = np.empty(width, np.float32), np.full(width + 2 * radius, OUTSIDE)
    total, totals = np.empty((4, width), np.float32), np.zeros((4, width + 2 * radius), np.float32)
    for y in range(start, start + len(shares)):
        first, last = max(y - radius, 0), min(y + radius + 1, height)
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


IMAGE, MAPS = numba.float32[:, :, ::1], numba.float32[:, :, :]


@numba.njit(
    numba.void(IMAGE, IMAGE, MAPS, MAPS, numba.int64[::1], numba.float32[:, :, :, ::1], numba.float32[:, :, :, ::1]),
    cache=True,
    parallel=True,
    error_model="numpy",
)
def fuse_image(fused: Any, image: Any, importance: Any, mixture: Any, windows: Any, sums: Any, mixtures: Any) -> None:
    height = image.shape[1]
    for strip in numba.prange((height + STRIP - 1) // STRIP):
        start, stop = strip * STRIP, min((strip + 1) * STRIP, height)
        # Each thread has scratch of its own: memory that is allocated here would be cleared anew for every strip.
        weighted, shares = sums[get_thread_id()], mixtures[get_thread_id()]
        for i in range(windows.size):
            unpack(shares[i, : stop - start], mixture[i, start:stop])
        for y in range(stop - start):
            softmax(shares, y)
        for i in range(windows.size):
            radius = windows[i] // 2
            low, high = max(start - radius, 0), min(stop + radius, height)
            logits = weighted[4, : high - low]
            unpack(logits, importance[i, low:high])
            if logits.max() - logits.min() <= SAFE_RANGE:
                filter_strip(fused, image, logits, shares[i, : stop - start], radius, start, low, weighted)
            else:
                filter_strip_in_steps(fused, image, logits, shares[i, : stop - start], radius, start, low)


def fuse(image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int]) -> Tensor:
    """See models.fusion.fuse; the image has three channels. The maps may have any strides."""
    threads()
    fused = torch.zeros_like(image, memory_format=torch.contiguous_format)
    count, width = numba.get_num_threads(), image.shape[-1]
    scratch = (
        np.empty((count, 5, STRIP + max(windows), width), np.float32),
        np.empty((count, len(windows), STRIP, width), np.float32),
    )
    for item in range(len(image)):
        maps = importance[item].detach().numpy(), mixture[item].detach().numpy()
        fuse_image(fused[item].numpy(), array(image[item]), *maps, np.array(windows), *scratch)
    return fused
