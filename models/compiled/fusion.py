"""models.fusion for the processor: strips of rows, each within a core's cache, every loop along a row vectorised."""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled import array, threads
from models.compiled.exponential import exp

STRIP = 32  # rows
SAFE_RANGE = np.float32(80)  # see models.fusion
LEAST_EXPONENT = np.float32(-80)
OUTSIDE = np.float32(-1e30)

jit = numba.njit(cache=True, fastmath={"contract", "arcp", "reassoc", "nsz"}, error_model="numpy", boundscheck=False)


@jit
def column_sums(total: Any, source: Any, first: int, last: int) -> None:
    """total (4, W) = sum of rows first to last - 1 of source (4, rows, W)."""
    for c in range(4):
        row = total[c]
        row[:] = source[c, first]
        for y in range(first + 1, last):
            line = source[c, y]
            for x in range(row.size):
                row[x] += line[x]


@jit
def row_sums(total: Any, columns: Any, radius: int) -> None:
    """total (4, W) = sums of 2 radius + 1 neighbours in columns (4, W + 2 radius)."""
    for c in range(4):
        row, line = total[c], columns[c]
        width = row.size
        row[:] = line[:width]
        for tap in range(1, 2 * radius + 1):
            for x in range(width):
                row[x] += line[x + tap]


@jit
def mix(fused: Any, total: Any, share: Any) -> None:
    """fused (3, W) += share (W) times the ratio of sums in total (4, W)."""
    for x in range(share.size):
        factor = share[x] / total[3, x]
        for c in range(3):
            fused[c, x] += factor * total[c, x]


@jit
def unpack(planes: Any, maps: Any) -> None:
    """planes (rows, W) = maps (rows, W), of any strides."""
    for y in range(planes.shape[0]):
        line = planes[y]
        for x in range(line.size):
            line[x] = maps[y, x]


@jit
def softmax(shares: Any) -> None:
    """shares (M, W) become their softmax over M."""
    count, width = shares.shape
    top, total = shares[0].copy(), np.zeros(width, np.float32)
    for i in range(1, count):
        for x in range(width):
            top[x] = max(top[x], shares[i, x])
    for i in range(count):
        for x in range(width):
            shares[i, x] = exp(max(shares[i, x] - top[x], LEAST_EXPONENT))
            total[x] += shares[i, x]
    for i in range(count):
        for x in range(width):
            shares[i, x] /= total[x]


@jit
def filter_strip(fused: Any, image: Any, logits: Any, shares: Any, radius: int, start: int, low: int) -> None:
    """Add a window's share to a strip of rows from `start` on.

    `fused` and `image` (3, H, W) are whole; `logits` (rows, W), from row `low` on, cover the windows of the strip
    and lie within SAFE_RANGE; `shares` (strip, W).
    """
    height, width = image.shape[1:]
    rows, stop = len(logits), start + len(shares)
    shift = (logits.min() + logits.max()) / np.float32(2)
    weighted = np.empty((4, rows, width), np.float32)
    for y in range(rows):
        line = weighted[3, y]
        for x in range(width):
            line[x] = exp(logits[y, x] - shift)
        for c in range(3):
            for x in range(width):
                weighted[c, y, x] = image[c, low + y, x] * line[x]
    columns = np.zeros((4, width + 2 * radius), np.float32)
    total = np.empty((4, width), np.float32)
    for y in range(start, stop):
        column_sums(
            columns[:, radius : radius + width], weighted, max(y - radius, 0) - low, min(y + radius + 1, height) - low
        )
        row_sums(total, columns, radius)
        mix(fused[:, y], total, shares[y - start])


@jit
def gather_in_steps(top: Any, total: Any, entries: Any, values: Any, taps: int) -> None:
    """top (W), total (4, W): largest entry (taps, W) and sum of exp(entry - top) * value (4, taps, W)."""
    top[:] = entries[0]
    for tap in range(1, taps):
        for x in range(top.size):
            top[x] = max(top[x], entries[tap, x])
    total[:] = 0
    for tap in range(taps):
        for x in range(top.size):
            inside = np.float32(entries[tap, x] > OUTSIDE)
            weight = inside * exp(max(entries[tap, x] - top[x], LEAST_EXPONENT))
            for c in range(4):
                total[c, x] += weight * values[c, tap, x]


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
        gather_in_steps(
            tops[radius : radius + width], totals[:, radius : radius + width], entries, values, last - first
        )
        for tap in range(taps):
            entries[tap] = tops[tap : tap + width]
            values[:, tap] = totals[:, tap : tap + width]
        gather_in_steps(top, total, entries, values, taps)
        mix(fused[:, y], total, shares[y - start])


IMAGE, MAPS = numba.float32[:, :, ::1], numba.float32[:, :, :]


@numba.njit(numba.void(IMAGE, IMAGE, MAPS, MAPS, numba.int64[::1]), cache=True, parallel=True, error_model="numpy")
def fuse_image(fused: Any, image: Any, importance: Any, mixture: Any, windows: Any) -> None:
    height, width = image.shape[1:]
    for strip in numba.prange((height + STRIP - 1) // STRIP):
        start, stop = strip * STRIP, min((strip + 1) * STRIP, height)
        shares = np.empty((windows.size, stop - start, width), np.float32)
        for i in range(windows.size):
            unpack(shares[i], mixture[i, start:stop])
        for y in range(stop - start):
            softmax(shares[:, y])
        for i in range(windows.size):
            radius = windows[i] // 2
            low, high = max(start - radius, 0), min(stop + radius, height)
            logits = np.empty((high - low, width), np.float32)
            unpack(logits, importance[i, low:high])
            if logits.max() - logits.min() <= SAFE_RANGE:
                filter_strip(fused, image, logits, shares[i], radius, start, low)
            else:
                filter_strip_in_steps(fused, image, logits, shares[i], radius, start, low)


def fuse(image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int]) -> Tensor:
    """See models.fusion.fuse; the image has three channels. The maps may have any strides."""
    threads()
    fused = torch.zeros_like(image, memory_format=torch.contiguous_format)
    for item in range(len(image)):
        maps = importance[item].detach().numpy(), mixture[item].detach().numpy()
        fuse_image(fused[item].numpy(), array(image[item]), *maps, np.array(windows))
    return fused
