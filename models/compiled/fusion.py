"""models.networks.fusion for the CPU: strips of rows, each within a core's cache, every loop along a row vectorised.

Loops run over rows that are sliced off as wholes: indices that are sums might be negative, which NumPy counts from the
end, and slices of several dimensions might have any stride. Neither is vectorised.
"""

import functools
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numba
import numpy as np
import torch
from numba.np.ufunc.parallel import get_thread_id
from numpy.typing import NDArray
from torch import Tensor

from models.compiled.arrays import RGB, Image, Index, Plane, Row, Rows, Scalar, Signals, f32
from models.compiled.exponential import MIN_EXPONENT, exp
from models.compiled.jit import array, jit_in_any_order, jit_with_memory
from models.compiled.lines import add_line, copy_line, exclude, raise_line, triple, triple_of_lines
from models.operators import MIN_DIVISOR

WINDOWS = (3, 5, 7, 9, 11, 13)  # Fan et al. 2021, §5.3
SAFE_RANGE = 80.0  # of logits: exp(±40) times any radiance, summed, neither overflows nor vanishes in float32
OUTSIDE_LOGIT = -1e30  # logit of a tap outside the image, or without a surface
THREAD_ROWS = 32  # rows that a thread fuses at once
CHUNK_PIXELS = 256  # of all maps, they fit into the fastest cache


# (logits, shares, radius, start, low): a window's part of a strip of rows from `start` on. Logits (rows, W), from row
# `low` on, cover the windows of the strip; shares (strip, W) are the window's weight in each pixel.
Strip: TypeAlias = tuple[Plane, Plane, Index, Index, Index]


# --- Rows of W pixels -------------------------------------------------------------------------------------------------


@jit_in_any_order
def add_two(line: Row, a: Row, b: Row) -> None:
    for x in range(line.size):
        line[x] += a[x] + b[x]


@jit_in_any_order
def add_four(line: Row, a: Row, b: Row, c: Row, d: Row) -> None:
    for x in range(line.size):
        line[x] += (a[x] + b[x]) + (c[x] + d[x])


@jit_in_any_order
def widen(low: Row, high: Row, logits: Row) -> None:
    """low and high come to include the logits that are not OUTSIDE_LOGIT."""
    for x in range(logits.size):
        entry = logits[x]
        high[x] = entry if entry > high[x] else high[x]
        low[x] = entry if entry < low[x] and entry > f32(OUTSIDE_LOGIT) else low[x]


@jit_in_any_order
def weigh(weighted: RGB, weight: Row, logits: Row, shift: Scalar, colour: RGB) -> None:
    """weight = exp(logits - shift), 0 for OUTSIDE_LOGIT, and weighted colours."""
    r, g, b = weighted
    red, green, blue = colour
    for x in range(weight.size):
        w = exp(max(logits[x] - shift, f32(MIN_EXPONENT)))
        w = w if logits[x] > f32(OUTSIDE_LOGIT) else f32(0)
        weight[x] = w
        r[x] = w * red[x]
        g[x] = w * green[x]
        b[x] = w * blue[x]


# --- Rows and windows of them -----------------------------------------------------------------------------------------


@jit_in_any_order
def split_row(lines: Image, to: Index, maps: Image, row: Index) -> None:
    """Row `to` of lines (M, rows, W) = a row of maps (M, H, W), whose channels may lie side by side."""
    count, _, width = lines.shape
    for first in range(0, width, CHUNK_PIXELS):
        last = min(first + CHUNK_PIXELS, width)
        for i in range(count):
            copy_line(lines[i, to, first:last], maps[i, row, first:last])


@jit_in_any_order
def column_sums(columns: Rows, margin: Index, source: Image, first: Index, last: Index) -> None:
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
            add_line(line, source[c, y])


@jit_in_any_order
def row_sums(total: Rows, columns: Rows, radius: Index) -> None:
    """total (4, W) = sums of 2 radius + 1 neighbours in columns (4, W + 2 radius)."""
    width = total.shape[1]
    for c in range(4):
        line, source = total[c], columns[c]
        copy_line(line, source[:width])
        x = 1
        while x + 4 <= 2 * radius + 1:
            a, b = source[x : x + width], source[x + 1 : x + 1 + width]
            add_four(line, a, b, source[x + 2 : x + 2 + width], source[x + 3 : x + 3 + width])
            x += 4
        if x < 2 * radius + 1:
            add_two(line, source[x : x + width], source[x + 1 : x + 1 + width])


@jit_in_any_order
def mix(fused: Image, y: Index, total: Rows, share: Row) -> None:
    """Row y of fused (3, H, W) += share (W) times the sums of colours over that of weights, in total (4, W)."""
    red, green, blue = triple(fused, y, 0, share.size)
    r, g, b = triple_of_lines(total, 0, share.size)
    weight = total[3]
    for x in range(share.size):
        factor = share[x] / max(weight[x], f32(MIN_DIVISOR))
        red[x] += factor * r[x]
        green[x] += factor * g[x]
        blue[x] += factor * b[x]


@jit_with_memory
def logit_range(logits: Plane) -> tuple[Scalar, Scalar]:
    """The lowest and highest of logits (n, W) that are not OUTSIDE_LOGIT, or OUTSIDE_LOGIT twice."""
    low = np.full(logits.shape[1], f32(np.inf))
    high = np.full(logits.shape[1], f32(OUTSIDE_LOGIT))
    for y in range(logits.shape[0]):
        widen(low, high, logits[y])
    top = high.max()
    return min(low.min(), top), top


@jit_in_any_order
def softmax(shares: Image, y: Index, top: Row, total: Row) -> None:
    """Row y of shares (M, rows, W) becomes its softmax over M; top and total (W) are scratch."""
    count, _, width = shares.shape
    copy_line(top, shares[0, y])
    for i in range(1, count):
        raise_line(top, shares[i, y])
    total[:] = f32(0)
    for i in range(count):
        share = shares[i, y]
        for x in range(width):
            exponent = share[x] - top[x]
            share[x] = exp(exponent if exponent > f32(MIN_EXPONENT) else f32(MIN_EXPONENT))
            total[x] += share[x]
    for i in range(count):
        share = shares[i, y]
        for x in range(width):
            share[x] /= total[x]


@jit_with_memory
def filter_strip(fused: Image, image: Image, strip: Strip, shift: Scalar, weighted: Image) -> None:
    """Add a window's share to a strip of fused (3, H, W): fused_p += share_p Σ_q w_q image_q / Σ_q w_q (Eq. 5).

    w_q = exp(logit_q - shift), so all logits lie within SAFE_RANGE around `shift`, or are OUTSIDE_LOGIT; `weighted`
    (4, rows or more, W) is scratch.
    """
    logits, shares, radius, start, low = strip
    height, width = image.shape[1:]
    for y in range(len(logits)):
        colour = triple(image, low + y, 0, width)
        weigh(triple(weighted, y, 0, width), weighted[3, y], logits[y], shift, colour)
    columns = np.zeros((4, width + 2 * radius), np.float32)
    total = np.empty((4, width), np.float32)
    for y in range(start, start + len(shares)):
        column_sums(columns, radius, weighted, max(y - radius, 0) - low, min(y + radius + 1, height) - low)
        row_sums(total, columns, radius)
        mix(fused, y, total, shares[y - start])


@jit_with_memory
def gather_in_steps(tops: Row, totals: Rows, margin: Index, entries: Rows, values: Image, taps: Index) -> None:
    """Largest entry (taps, W), and sums of exp(entry - largest) * value (4, taps, W), into tops and totals.

    These have `margin` entries more on both sides: tops (W + 2 margin), totals (4, W + 2 margin).
    """
    width = entries.shape[1]
    top = tops[margin : margin + width]
    weight = np.empty(width, np.float32)
    copy_line(top, entries[0])
    for tap in range(1, taps):
        raise_line(top, entries[tap])
    totals[:] = 0
    for tap in range(taps):
        entry = entries[tap]
        for x in range(width):
            exponent = entry[x] - top[x]
            exponent = exponent if exponent > f32(MIN_EXPONENT) else f32(MIN_EXPONENT)
            weight[x] = exp(exponent) if entry[x] > f32(OUTSIDE_LOGIT) else f32(0)
        for c in range(4):
            total = totals[c][margin : margin + width]
            value = values[c, tap]
            for x in range(width):
                total[x] += weight[x] * value[x]


@jit_with_memory
def filter_strip_in_steps(fused: Image, image: Image, strip: Strip) -> None:
    """The same for any finite logits: relative to the largest of every window, columns first, then rows."""
    logits, shares, radius, start, low = strip
    height, width = image.shape[1:]
    taps = 2 * radius + 1
    entries = np.empty((taps, width), np.float32)
    values = np.zeros((4, taps, width), np.float32)
    top = np.empty(width, np.float32)
    tops = np.full(width + 2 * radius, f32(OUTSIDE_LOGIT))
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
    fused: Image,
    image: Image,
    surface: Plane,
    importance: Image,
    mixture: Image,
    windows: NDArray[np.int64],
    logits: Signals,
    shares: Signals,
    weighted: Signals,
) -> None:
    """fused (3, H, W) += image (3, H, W) filtered, of the pixels of the surface (H, W), strips in parallel.

    logits (threads, M, rows, W), shares (threads, M, THREAD_ROWS, W) and weighted (threads, 4, rows, W) are scratch of
    the threads' own: memory that is allocated within the loop would be cleared anew for every strip.
    """
    _, height, width = image.shape
    margin = windows.max() // 2
    for number in numba.prange((height + THREAD_ROWS - 1) // THREAD_ROWS):
        start = np.int64(number) * THREAD_ROWS
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
            if surface[y].min() == 0:
                for i in range(windows.size):
                    exclude(my_logits[i, y - first], surface[y], f32(OUTSIDE_LOGIT))
        for i in range(windows.size):
            radius = windows[i] // 2
            low = max(start - radius, 0)
            entries = my_logits[i, low - first : min(stop + radius, height) - first]
            bottom, top = logit_range(entries)
            strip = (entries, my_shares[i, : stop - start], radius, start, low)
            if top - bottom <= f32(SAFE_RANGE):
                filter_strip(fused, image, strip, (bottom + top) / f32(2), my_weighted)
            else:
                filter_strip_in_steps(fused, image, strip)


@functools.cache
def compiled_fuse_strips() -> Callable[..., None]:
    """`fuse_strips`, compiled once for maps of any strides. That takes seconds even from disk: not at import."""
    image = numba.float32[:, :, ::1]
    maps = numba.float32[:, :, :]
    scratch = numba.float32[:, :, :, ::1]
    signature = numba.void(image, image, numba.float32[:, ::1], maps, maps, numba.int64[::1], scratch, scratch, scratch)
    compiled: Callable[..., None] = numba.njit(signature, cache=True, parallel=True, error_model="numpy")(fuse_strips)
    return compiled


def fuse(
    image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int] = WINDOWS, surface: Tensor | None = None
) -> Tensor:
    """See models.networks.fusion.fuse. The maps are read as they lie in memory."""
    fused = torch.zeros_like(image, memory_format=torch.contiguous_format)
    surface = torch.ones_like(image[:, :1]) if surface is None else surface
    rows = THREAD_ROWS + max(windows)
    shapes = (len(windows), rows), (len(windows), THREAD_ROWS), (4, rows)
    scratch = [np.empty((numba.get_num_threads(), *shape, image.shape[-1]), np.float32) for shape in shapes]
    for item in range(len(image)):
        images = fused[item].numpy(), array(image[item]), array(surface[item, 0])
        maps = importance[item].detach().float().numpy(), mixture[item].detach().float().numpy()
        compiled_fuse_strips()(*images, *maps, np.array(windows), *scratch)
    return fused
