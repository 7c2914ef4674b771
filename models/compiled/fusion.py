"""models.networks.fusion for the CPU: strips of rows, each within a core's cache, every loop along a row vectorised.

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

from models.compiled.exponential import MIN_EXPONENT, exp
from models.compiled.jit import array, jit_in_any_order, jit_with_memory, plane_or_empty
from models.compiled.lines import copy_line
from models.operators import MIN_DIVISOR

WINDOWS = (3, 5, 7, 9, 11, 13)  # Fan et al. 2021, §5.3
SAFE_RANGE = 80.0  # of logits: exp(±40) times any radiance, summed, neither overflows nor vanishes in float32
OUTSIDE_LOGIT = -1e30  # logit of a tap outside the image, or without a surface
THREAD_ROWS = 32  # rows that a thread fuses at once
CHUNK = 256  # px; of all maps, they fit into the fastest cache


# --- Lines of W pixels ------------------------------------------------------------------------------------------------


@jit_in_any_order
def add_one(line: Any, a: Any) -> None:
    for x in range(line.size):
        line[x] += a[x]


@jit_in_any_order
def add_two(line: Any, a: Any, b: Any) -> None:
    for x in range(line.size):
        line[x] += a[x] + b[x]


@jit_in_any_order
def add_four(line: Any, a: Any, b: Any, c: Any, d: Any) -> None:
    for x in range(line.size):
        line[x] += (a[x] + b[x]) + (c[x] + d[x])


@jit_in_any_order
def leave_out(logits: Any, surface: Any) -> None:
    """logits become OUTSIDE_LOGIT where surface is 0."""
    for x in range(logits.size):
        logits[x] = logits[x] if surface[x] > 0 else np.float32(OUTSIDE_LOGIT)


@jit_in_any_order
def widen(low: Any, high: Any, logits: Any) -> None:
    """low and high come to include the logits that are not OUTSIDE_LOGIT."""
    for x in range(logits.size):
        entry = logits[x]
        high[x] = entry if entry > high[x] else high[x]
        low[x] = entry if entry < low[x] and entry > np.float32(OUTSIDE_LOGIT) else low[x]


@jit_in_any_order
def weigh(weight: Any, r: Any, g: Any, b: Any, logits: Any, shift: Any, red: Any, green: Any, blue: Any) -> None:
    """weight = exp(logits - shift), 0 for logits OUTSIDE_LOGIT, and r, g, b = weight times red, green, blue."""
    for x in range(weight.size):
        w = (
            exp(max(logits[x] - shift, np.float32(MIN_EXPONENT)))
            if logits[x] > np.float32(OUTSIDE_LOGIT)
            else np.float32(0)
        )
        weight[x] = w
        r[x] = w * red[x]
        g[x] = w * green[x]
        b[x] = w * blue[x]


@jit_in_any_order
def add_share(red: Any, green: Any, blue: Any, share: Any, r: Any, g: Any, b: Any, weight: Any) -> None:
    """red, green, blue += share times the sums r, g, b over that of weights."""
    for x in range(share.size):
        factor = share[x] / max(weight[x], np.float32(MIN_DIVISOR))
        red[x] += factor * r[x]
        green[x] += factor * g[x]
        blue[x] += factor * b[x]


# --- Rows and windows of them -----------------------------------------------------------------------------------------


@jit_in_any_order
def split_row(lines: Any, to: Any, maps: Any, row: Any) -> None:
    """Row `to` of lines (M, rows, W) = a row of maps (M, H, W), whose channels may lie side by side."""
    count, _, width = lines.shape
    for first in range(0, width, CHUNK):
        last = min(first + CHUNK, width)
        for i in range(count):
            copy_line(lines[i, to, first:last], maps[i, row, first:last])


@jit_in_any_order
def column_sums(columns: Any, margin: int, source: Any, first: Any, last: Any) -> None:
    """columns (4, W + 2 margin), within its margins, = sum of rows first to last - 1 of source (4, rows, W)."""
    width = source.shape[2]
    for c in range(4):
        line = columns[c, margin : margin + width]
        copy_line(line, source[c, first])
        y = first + 1
        while y + 4 <= last:
            add_four(line, source[c, y], source[c, y + 1], source[c, y + 2], source[c, y + 3])
            y += 4
        if y + 2 <= last:
            add_two(line, source[c, y], source[c, y + 1])
            y += 2
        if y < last:
            add_one(line, source[c, y])


@jit_in_any_order
def row_sums(total: Any, columns: Any, radius: Any) -> None:
    """total (4, W) = sums of 2 radius + 1 neighbours in columns (4, W + 2 radius)."""
    width = total.shape[1]
    for c in range(4):
        line = total[c]
        copy_line(line, columns[c, :width])
        x = 1
        while x + 4 <= 2 * radius + 1:
            add_four(
                line,
                columns[c, x : x + width],
                columns[c, x + 1 : x + 1 + width],
                columns[c, x + 2 : x + 2 + width],
                columns[c, x + 3 : x + 3 + width],
            )
            x += 4
        if x < 2 * radius + 1:
            add_two(line, columns[c, x : x + width], columns[c, x + 1 : x + 1 + width])


@jit_in_any_order
def mix(fused: Any, y: Any, total: Any, share: Any) -> None:
    """Row y of fused (3, H, W) += share (W) times the ratio of sums in total (4, W)."""
    add_share(fused[0, y], fused[1, y], fused[2, y], share, total[0], total[1], total[2], total[3])


@jit_with_memory
def logit_range(logits: Any) -> Any:
    """The lowest and highest of logits (n, W) that are not OUTSIDE_LOGIT, or OUTSIDE_LOGIT twice."""
    low = np.full(logits.shape[1], np.float32(np.inf))
    high = np.full(logits.shape[1], np.float32(OUTSIDE_LOGIT))
    for y in range(logits.shape[0]):
        widen(low, high, logits[y])
    top = high.max()
    return min(low.min(), top), top


@jit_in_any_order
def softmax(shares: Any, y: Any, top: Any, total: Any) -> None:
    """Row y of shares (M, rows, W) becomes its softmax over M; top and total (W) are scratch."""
    count, _, width = shares.shape
    copy_line(top, shares[0, y])
    for i in range(1, count):
        share = shares[i, y]
        for x in range(width):
            top[x] = share[x] if share[x] > top[x] else top[x]
    for x in range(width):
        total[x] = 0
    for i in range(count):
        share = shares[i, y]
        for x in range(width):
            exponent = share[x] - top[x]
            share[x] = exp(exponent if exponent > np.float32(MIN_EXPONENT) else np.float32(MIN_EXPONENT))
            total[x] += share[x]
    for i in range(count):
        share = shares[i, y]
        for x in range(width):
            share[x] /= total[x]


@jit_with_memory
def filter_strip(
    fused: Any, image: Any, logits: Any, shift: Any, shares: Any, radius: Any, start: Any, low: Any, weighted: Any
) -> None:
    """Add a window's share to a strip of rows from `start` on.

    `fused` and `image` (3, H, W) are whole; `logits` (rows, W), from row `low` on, cover the windows of the strip and
    lie within SAFE_RANGE around `shift`, or are OUTSIDE_LOGIT; `shares` (strip, W); `weighted` (4, rows or more, W) is
    scratch.
    """
    height, width = image.shape[1:]
    stop = start + len(shares)
    for y in range(len(logits)):
        r = weighted[0, y]
        g = weighted[1, y]
        b = weighted[2, y]
        weigh(weighted[3, y], r, g, b, logits[y], shift, image[0, low + y], image[1, low + y], image[2, low + y])
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
    copy_line(top, entries[0])
    for tap in range(1, taps):
        entry = entries[tap]
        for x in range(width):
            top[x] = entry[x] if entry[x] > top[x] else top[x]
    totals[:] = 0
    for tap in range(taps):
        entry = entries[tap]
        for x in range(width):
            exponent = entry[x] - top[x]
            exponent = exponent if exponent > np.float32(MIN_EXPONENT) else np.float32(MIN_EXPONENT)
            weight[x] = exp(exponent) if entry[x] > np.float32(OUTSIDE_LOGIT) else np.float32(0)
        for c in range(4):
            total = totals[c][margin : margin + width]
            value = values[c, tap]
            for x in range(width):
                total[x] += weight[x] * value[x]


@jit_with_memory
def filter_strip_in_steps(fused: Any, image: Any, logits: Any, shares: Any, radius: Any, start: Any, low: Any) -> None:
    """The same for any finite logits: relative to the largest of every window, columns first, then rows."""
    height, width = image.shape[1:]
    taps = 2 * radius + 1
    entries = np.empty((taps, width), np.float32)
    values = np.zeros((4, taps, width), np.float32)
    top = np.empty(width, np.float32)
    tops = np.full(width + 2 * radius, np.float32(OUTSIDE_LOGIT))
    total = np.empty((4, width), np.float32)
    totals = np.zeros((4, width + 2 * radius), np.float32)
    for y in range(start, start + len(shares)):
        first = max(y - radius, 0)
        last = min(y + radius + 1, height)
        for tap in range(last - first):
            copy_line(entries[tap], logits[first + tap - low])
            for c in range(3):
                copy_line(values[c, tap], image[c, first + tap])
            values[3, tap] = 1
        gather_in_steps(tops, totals, radius, entries, values, last - first)
        for tap in range(taps):
            copy_line(entries[tap], tops[tap : tap + width])
            for c in range(4):
                copy_line(values[c, tap], totals[c, tap : tap + width])
        gather_in_steps(top, total, 0, entries, values, taps)
        mix(fused, y, total, shares[y - start])


def fuse_strips(
    fused: Any,
    image: Any,
    surface: Any,
    importance: Any,
    mixture: Any,
    windows: Any,
    logits: Any,
    shares: Any,
    weighted: Any,
) -> None:
    """fused (3, H, W) += image (3, H, W) filtered, strips in parallel; surface (H, W) is empty where all pixels count.

    logits (threads, M, rows, W), shares (threads, M, THREAD_ROWS, W) and weighted (threads, 4, rows, W) are scratch of
    the threads' own: memory that is allocated within the loop would be cleared anew for every strip.
    """
    _, height, width = image.shape
    margin = windows.max() // 2
    for strip in numba.prange((height + THREAD_ROWS - 1) // THREAD_ROWS):
        start = np.int64(strip) * THREAD_ROWS
        stop = min(start + THREAD_ROWS, height)
        first = max(start - margin, 0)
        last = min(stop + margin, height)
        my_weighted = weighted[get_thread_id()]
        my_logits = logits[get_thread_id()]
        my_shares = shares[get_thread_id()]
        scratch = np.empty((2, width), np.float32)
        for y in range(start, stop):
            split_row(my_shares, y - start, mixture, y)
            softmax(my_shares, y - start, scratch[0], scratch[1])
        for y in range(first, last):
            split_row(my_logits, y - first, importance, y)
            if surface.size > 0 and surface[y].min() == 0:
                for i in range(windows.size):
                    leave_out(my_logits[i, y - first], surface[y])
        for i in range(windows.size):
            radius = windows[i] // 2
            low = max(start - radius, 0)
            high = min(stop + radius, height)
            entries = my_logits[i, low - first : high - first]
            bottom, top = logit_range(entries)
            my_share = my_shares[i, : stop - start]
            if top - bottom <= np.float32(SAFE_RANGE):
                shift = (bottom + top) / np.float32(2)
                filter_strip(fused, image, entries, shift, my_share, radius, start, low, my_weighted)
            else:
                filter_strip_in_steps(fused, image, entries, my_share, radius, start, low)


@functools.cache
def compiled_fuse_strips() -> Any:
    """`fuse_strips`, compiled once for maps of any strides. That takes seconds even from disk: not at import."""
    image = numba.float32[:, :, ::1]
    maps = numba.float32[:, :, :]
    scratch = numba.float32[:, :, :, ::1]
    signature = numba.void(image, image, numba.float32[:, ::1], maps, maps, numba.int64[::1], scratch, scratch, scratch)
    return numba.njit(signature, cache=True, parallel=True, error_model="numpy")(fuse_strips)


def fuse(
    image: Tensor,
    importance: Tensor,
    mixture: Tensor,
    windows: Sequence[int] = WINDOWS,
    surface: Tensor | None = None,
) -> Tensor:
    """See models.networks.fusion.fuse. The maps are read as they lie in memory."""
    fused = torch.zeros_like(image, memory_format=torch.contiguous_format)
    threads = numba.get_num_threads()
    width = image.shape[-1]
    count = len(windows)
    rows = THREAD_ROWS + max(windows)
    logits = np.empty((threads, count, rows, width), np.float32)
    shares = np.empty((threads, count, THREAD_ROWS, width), np.float32)
    weighted = np.empty((threads, 4, rows, width), np.float32)
    for item in range(len(image)):
        images = fused[item].numpy(), array(image[item]), plane_or_empty(surface, item)
        maps = importance[item].detach().float().numpy(), mixture[item].detach().float().numpy()
        compiled_fuse_strips()(*images, *maps, np.array(windows), logits, shares, weighted)
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
