"""models.filters.svgf for the processor: every row by itself, every loop along it vectorised.

Each line of memory has a name of its own in the innermost functions: Numba knows slices along the last dimension as
contiguous, unlike lines of a slice in two dimensions. Scratch memory is flat, with offsets that are constants: LLVM
vectorises a loop only where it can tell, by few comparisons, that what is written overlaps nothing that is read.
"""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from datasets.channels import LUMINANCE_WEIGHTS
from datasets.frame import Frame
from models.compiled.exponential import exp
from models.compiled.jit import (
    array,
    jit_in_any_order,
    jit_inlined_in_any_order,
    jit_parallel,
    jit_with_memory,
    jit_with_reciprocals,
    plane_or_empty,
)
from models.compiled.lines import copy_line
from models.compiled.reprojection import BLOCK_ROWS, ONE, Buffers, Past, Views, fetch, find_row, new_search
from models.filters.atrous import B3_SPLINE, RADIUS
from models.history.geometry import GBuffer
from models.operators import MAX_LUMINANCE, MIN_DIVISOR

ALPHA = 0.2  # §4.1: weight of the newest sample
SPATIAL_RADIUS = 3  # §4.2: windows of 7 x 7
SIGMA_Z = 1.0  # §4.4
SIGMA_L = 4.0
SQUARINGS = 7  # σ_n = 128 = 2^7
EPSILON_Z = 1e-3  # of the depth
EPSILON_L = 1e-20  # luminance²

RED_WEIGHT, GREEN_WEIGHT, BLUE_WEIGHT = (np.float32(weight) for weight in LUMINANCE_WEIGHTS)
unsigned = np.uint64  # an index that cannot count from the end: one that can, keeps loops scalar
NEGLIGIBLE_COSINE = np.float32(0.79)  # to the 128th it is 8e-14
NEGLIGIBLE_WEIGHT = np.float32(1e-15)
NEGLIGIBLE_EXPONENT = np.float32(40)  # e^-40 is below NEGLIGIBLE_WEIGHT
MIN_GAUSSIAN_SHARE = np.float32(1 / 16)  # of one pixel in a Gaussian of 3 x 3
SPLINE = np.array(B3_SPLINE, np.float32)
TAPS = 2 * RADIUS + 1  # of a row
LEVEL_BLOCK = 256  # px; so many of a row are filtered together, and what they need stays in the first cache
GEOMETRY = 7  # lines of pack_geometry
SIGNAL = 6
SPATIAL_BLOCK = 64  # px; the spatial estimate is made for all of a block where one needs it


# --- Temporal integration ---------------------------------------------------------------------------------------------


@jit_with_reciprocals
def clamp_luminance(y: Any, red: Any, green: Any, blue: Any) -> None:
    for x in range(y.size):
        luminance = RED_WEIGHT * red[x] + GREEN_WEIGHT * green[x] + BLUE_WEIGHT * blue[x]
        y[x] = min(max(luminance, -np.float32(MAX_LUMINANCE)), np.float32(MAX_LUMINANCE))


@jit_with_reciprocals
def square(line: Any, y: Any) -> None:
    for x in range(line.size):
        line[x] = y[x] * y[x]


@jit_with_reciprocals
def weigh(alpha: Any, length: Any, past_length: Any, change: Any, found: Any) -> None:
    """The weight of the newest frame and the new history length, (W), where `change` of the history is given up."""
    for x in range(alpha.size):
        kept = ONE - change[x]
        alpha[x] = kept * np.float32(ALPHA) + change[x]
        length[x] = past_length[x] * kept + ONE if found[x] > 0 else ONE


@jit_with_reciprocals
def blend(line: Any, past: Any, new: Any, alpha: Any, found: Any) -> None:
    for x in range(line.size):
        line[x] = past[x] + alpha[x] * (new[x] - past[x]) if found[x] > 0 else new[x]


@jit_parallel
def integrate_image(
    colour: Any,
    moments: Any,
    length: Any,
    noisy: Any,
    past_colour: Any,
    past_moments: Any,
    past_length: Any,
    change: Any,
    motion: Any,
    now: Buffers,
    then: Buffers,
    views: Views,
) -> None:
    """colour (S, 3, H, W), moments (S, 2, H, W) and length (H, W) from `noisy` colour and the history.

    change (H, W) is empty for none.
    """
    signals, _, height, width = noisy.shape
    for block in numba.prange((height + BLOCK_ROWS - 1) // BLOCK_ROWS):
        search = new_search(width)
        fetched = np.empty(width, np.float32)
        new = np.empty((2, width), np.float32)
        alpha = np.empty(width, np.float32)
        none = np.zeros(width, np.float32)
        start = np.int64(block) * BLOCK_ROWS
        for y in range(start, min(start + BLOCK_ROWS, height)):
            find_row(search, y, Past(motion, now, then, views))
            fetch(fetched, past_length, y, search)
            weigh(alpha, length[y], fetched, change[y] if change.size > 0 else none, search.found)
            for s in range(signals):
                for c in range(3):
                    fetch(fetched, past_colour[s, c], y, search)
                    blend(colour[s, c, y], fetched, noisy[s, c, y], alpha, search.found)
                clamp_luminance(new[0], noisy[s, 0, y], noisy[s, 1, y], noisy[s, 2, y])
                square(new[1], new[0])
                for c in range(2):
                    fetch(fetched, past_moments[s, c], y, search)
                    blend(moments[s, c, y], fetched, new[c], alpha, search.found)


def integrate_samples(
    frame: Frame,
    noisy: Tensor,
    past_colour: Tensor,
    past_moments: Tensor,
    past_length: Tensor,
    gbuffer: GBuffer,
    change: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See models.filters.svgf.integrate_samples."""
    colour = torch.empty_like(noisy, memory_format=torch.contiguous_format)
    moments = torch.empty_like(past_moments, memory_format=torch.contiguous_format)
    length = torch.empty_like(past_length, memory_format=torch.contiguous_format)
    for item in range(len(noisy)):
        integrate_image(
            colour[item].numpy(),
            moments[item].numpy(),
            length[item, 0].numpy(),
            array(noisy[item]),
            array(past_colour[item]),
            array(past_moments[item]),
            array(past_length[item, 0]),
            plane_or_empty(change, item),
            *Past.of(frame, gbuffer, item),
        )
    return colour, moments, length


# --- What stops the filters at edges of surfaces ----------------------------------------------------------------------


@jit_in_any_order
def nearer_to_zero(a: Any, b: Any) -> Any:
    """Which of two is nearer to 0; 0 where both are infinite."""
    nearer = a if abs(a) < abs(b) else b
    return nearer if abs(nearer) < np.inf else np.float32(0)


@jit_in_any_order
def depth_steps(step: Any, depth: Any, to_depth: Any, mesh: Any, to_mesh: Any) -> None:
    """step (n): change of depth to the neighbours, infinite where they are on another mesh."""
    for i in range(step.size):
        step[i] = to_depth[i] - depth[i] if mesh[i] == to_mesh[i] else np.float32(np.inf)


@jit_with_memory
def pack_geometry_row(packed: Any, row: Any, depth: Any, normal: Any, mesh: Any) -> None:
    """A row of packed (7, H, W) from depth (H, W), normal (3, H, W), mesh (H, W)."""
    height, width = depth.shape
    z = depth[row]
    here = mesh[row]
    ahead = np.full(width, np.float32(np.inf))
    behind = np.full(width, np.float32(np.inf))
    across = np.full(width + 1, np.float32(np.inf))
    if row + 1 < height:
        depth_steps(ahead, z, depth[row + 1], here, mesh[row + 1])
    if row > 0:
        depth_steps(behind, depth[row - 1], z, mesh[row - 1], here)
    depth_steps(across[1:width], z[:-1], z[1:], here[:-1], here[1:])
    x = normal[0, row]
    y = normal[1, row]
    n_z = normal[2, row]
    out_x = packed[0, row]
    out_y = packed[1, row]
    out_z = packed[2, row]
    out_depth = packed[3, row]
    along_x = packed[4, row]
    along_y = packed[5, row]
    tolerance = packed[6, row]
    for i in range(width):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + n_z[i] * n_z[i])
        normalise = np.float32(1) / max(length, np.float32(MIN_DIVISOR)) if z[i] > 0 else np.float32(0)
        out_x[i] = x[i] * normalise
        out_y[i] = y[i] * normalise
        out_z[i] = n_z[i] * normalise
        out_depth[i] = z[i]
        along_x[i] = np.float32(SIGMA_Z) * nearer_to_zero(across[i + 1], across[i])
        along_y[i] = np.float32(SIGMA_Z) * nearer_to_zero(ahead[i], behind[i])
        tolerance[i] = np.float32(EPSILON_Z) * abs(z[i]) + np.float32(MIN_DIVISOR)


@jit_parallel
def pack_geometry_image(packed: Any, depth: Any, normal: Any, mesh: Any) -> None:
    for row in numba.prange(depth.shape[0]):
        pack_geometry_row(packed, np.int64(row), depth, normal, mesh)


def pack_geometry(depth: Tensor, normal: Tensor, mesh_id: Tensor) -> Tensor:
    """See models.filters.svgf.pack_geometry."""
    packed = depth.new_empty(len(depth), 1, 7, *depth.shape[-2:])
    for item in range(len(depth)):
        pack_geometry_image(
            packed[item, 0].numpy(), array(depth[item, 0]), array(normal[item]), array(mesh_id[item, 0])
        )
    return packed


@jit_inlined_in_any_order
def geometry_terms(
    x: Any,
    y: Any,
    z: Any,
    depth: Any,
    along_x: Any,
    along_y: Any,
    tolerance: Any,
    to_x: Any,
    to_y: Any,
    to_z: Any,
    to_depth: Any,
    dx: Any,
    dy: Any,
) -> tuple[Any, Any]:
    """models.filters.svgf.geometry_weight of one pixel as w times e to the power of -exponent."""
    w_n = x * to_x + y * to_y + z * to_z
    w_n = w_n if w_n > NEGLIGIBLE_COSINE else np.float32(0)
    for _ in range(SQUARINGS):
        w_n *= w_n
    return w_n, abs(depth - to_depth) / (abs(along_x * dx + along_y * dy) + tolerance)


@jit_inlined_in_any_order
def weight(w: Any, exponent: Any) -> Any:
    """w times e to the power of -exponent, 0 where that is negligible: denormal numbers are slow."""
    w *= exp(-min(exponent, NEGLIGIBLE_EXPONENT))
    return w if w > NEGLIGIBLE_WEIGHT else np.float32(0)


@jit_in_any_order
def geometry_weights(weights: Any, geometry: Any, row: Any, left: int, dx: int, dy: int) -> None:
    """As weights (n) filters.svgf.geometry_weight of the n pixels from `left` on in a row of the geometry (7, H, W)."""
    right = left + weights.size
    to = row + dy
    to_left = left + dx
    to_right = right + dx
    x = geometry[0, row, left:right]
    y = geometry[1, row, left:right]
    z = geometry[2, row, left:right]
    to_x = geometry[0, to, to_left:to_right]
    to_y = geometry[1, to, to_left:to_right]
    to_z = geometry[2, to, to_left:to_right]
    depth = geometry[3, row, left:right]
    to_depth = geometry[3, to, to_left:to_right]
    along_x = geometry[4, row, left:right]
    along_y = geometry[5, row, left:right]
    tolerance = geometry[6, row, left:right]
    by_x = np.float32(dx)
    by_y = np.float32(dy)
    for i in range(weights.size):
        here = (x[i], y[i], z[i], depth[i], along_x[i], along_y[i], tolerance[i])
        weights[i] = weight(*geometry_terms(*here, to_x[i], to_y[i], to_z[i], to_depth[i], by_x, by_y))


# --- The à-trous transform --------------------------------------------------------------------------------------------
#
# All taps of a row are taken at once, so that a pixel's own values and its sums stay in registers for five taps. What
# taps read lies row by row: `surfaces` (H, GEOMETRY, W), the lines of pack_geometry, and `signals` (H, S, SIGNAL, W),
# of each signal red, green, blue, variance, luminance, edge_scale. On either side is a margin of background, from which
# no tap takes anything, so that none needs to ask where the image ends.


@jit_in_any_order
def weigh_taps(weights: Any, h: Any, surfaces: Any, row: Any, to: Any, step: int, first: int, count: int) -> None:
    """Geometrical weights of all taps in the row `to`, for `count` pixels of a row from `first` on.

    As weights (2 * TAPS * LEVEL_BLOCK): for each tap the two that geometry_terms returns, the first times h (TAPS).
    """
    x = surfaces[row, 0]
    y = surfaces[row, 1]
    z = surfaces[row, 2]
    depth = surfaces[row, 3]
    along_x = surfaces[row, 4]
    along_y = surfaces[row, 5]
    tolerance = surfaces[row, 6]
    to_x = surfaces[to, 0]
    to_y = surfaces[to, 1]
    to_z = surfaces[to, 2]
    to_depth = surfaces[to, 3]
    dy = np.float32(to - row)
    for i in range(count):
        p = unsigned(first + i)
        here = (x[p], y[p], z[p], depth[p], along_x[p], along_y[p], tolerance[p])
        for tap in range(TAPS):
            dx = (tap - RADIUS) * step
            q = unsigned(first + i + dx)
            w_n, exponent = geometry_terms(*here, to_x[q], to_y[q], to_z[q], to_depth[q], np.float32(dx), dy)
            weights[unsigned(2 * tap * LEVEL_BLOCK + i)] = h[tap] * w_n
            weights[unsigned((2 * tap + 1) * LEVEL_BLOCK + i)] = exponent


@jit_in_any_order
def add_taps(
    sums: Any, weights: Any, signals: Any, s: int, row: Any, to: Any, step: int, first: int, count: int
) -> None:
    """Add all taps in the row `to`, with the weights of weigh_taps, to sums (5 * LEVEL_BLOCK).

    Of colours, of variances, of weights.
    """
    r = signals[to, s, 0]
    g = signals[to, s, 1]
    b = signals[to, s, 2]
    v = signals[to, s, 3]
    to_y = signals[to, s, 4]
    y = signals[row, s, 4]
    scale = signals[row, s, 5]
    for i in range(count):
        p = unsigned(first + i)
        red = np.float32(0)
        green = np.float32(0)
        blue = np.float32(0)
        spread = np.float32(0)
        total = np.float32(0)
        for tap in range(TAPS):
            q = unsigned(first + i + (tap - RADIUS) * step)
            exponent = weights[unsigned((2 * tap + 1) * LEVEL_BLOCK + i)]
            w = weight(weights[unsigned(2 * tap * LEVEL_BLOCK + i)], abs(y[p] - to_y[q]) * scale[p] + exponent)
            red += w * r[q]
            green += w * g[q]
            blue += w * b[q]
            spread += w * w * v[q]
            total += w
        sums[unsigned(i)] += red
        sums[unsigned(i + LEVEL_BLOCK)] += green
        sums[unsigned(i + 2 * LEVEL_BLOCK)] += blue
        sums[unsigned(i + 3 * LEVEL_BLOCK)] += spread
        sums[unsigned(i + 4 * LEVEL_BLOCK)] += total


@jit_in_any_order
def divide_sums(filtered: Any, signals: Any, row: Any, s: int, first: int, count: int, sums: Any) -> None:
    """Colour and variance of `count` pixels of `filtered` from `first` on, from sums (5 * LEVEL_BLOCK)."""
    h = SPLINE[RADIUS] * SPLINE[RADIUS]
    for c in range(3):
        line = filtered[row, s, c]
        centre = signals[row, s, c]
        for i in range(count):
            p = unsigned(first + i)
            line[p] = (sums[unsigned(i + c * LEVEL_BLOCK)] + h * centre[p]) / (sums[unsigned(i + 4 * LEVEL_BLOCK)] + h)
    line = filtered[row, s, 3]
    centre = signals[row, s, 3]
    for i in range(count):
        p = unsigned(first + i)
        normalise = np.float32(1) / (sums[unsigned(i + 4 * LEVEL_BLOCK)] + h)
        line[p] = (sums[unsigned(i + 3 * LEVEL_BLOCK)] + h * h * centre[p]) * normalise * normalise


@jit_parallel
def filter_image(filtered: Any, signals: Any, surfaces: Any, margin: int, step: int) -> None:
    """Colour and variance of `filtered`, as `signals`, by one level with taps `step` pixels apart."""
    height, count_signals, _, width = signals.shape
    for line in numba.prange(height):
        row = np.int64(line)
        sums = np.empty((count_signals, 5 * LEVEL_BLOCK), np.float32)
        weights = np.empty(2 * TAPS * LEVEL_BLOCK, np.float32)
        h = np.empty(TAPS, np.float32)
        for first in range(margin, width - margin, LEVEL_BLOCK):
            count = min(LEVEL_BLOCK, width - margin - first)
            sums[:] = 0
            for j in range(-RADIUS, RADIUS + 1):
                to = row + j * step
                if to < 0 or to >= height:
                    continue
                h[:] = SPLINE[j + RADIUS] * SPLINE
                if j == 0:
                    h[RADIUS] = 0  # the pixel itself, of which divide_sums takes care
                weigh_taps(weights, h, surfaces, row, to, step, first, count)
                for s in range(count_signals):
                    add_taps(sums[s], weights, signals, s, row, to, step, first, count)
            for s in range(count_signals):
                divide_sums(filtered, signals, row, s, first, count, sums[s])


@jit_in_any_order
def add_weighted(total: Any, weight: Any, h: Any, variance: Any, depth: Any) -> None:
    for x in range(total.size):
        share = h if depth[x] > 0 else np.float32(0)
        total[x] += share * variance[x]
        weight[x] += share


@jit_in_any_order
def finish_edge(luminance: Any, scale: Any, r: Any, g: Any, b: Any, columns: Any, inside: Any) -> None:
    """From weighted sums of columns, of variances and of weights, (W + 2)."""
    quarter = np.float32(0.25)
    half = np.float32(0.5)
    for x in range(scale.size):
        luminance[x] = RED_WEIGHT * r[x] + GREEN_WEIGHT * g[x] + BLUE_WEIGHT * b[x]
        mean = quarter * columns[x] + half * columns[x + 1] + quarter * columns[x + 2]
        share = quarter * inside[x] + half * inside[x + 1] + quarter * inside[x + 2]
        scale[x] = np.float32(1) / (
            np.float32(SIGMA_L) * np.sqrt(mean / max(share, MIN_GAUSSIAN_SHARE) + np.float32(EPSILON_L))
        )


@jit_with_memory
def edge_row(signals: Any, surfaces: Any, row: Any, s: int) -> None:
    """Luminance and models.filters.svgf.edge_scale of a row."""
    height, _, _, width = signals.shape
    columns = np.zeros(width + 2, np.float32)
    inside = np.zeros(width + 2, np.float32)
    for y in range(max(row - 1, 0), min(row + 2, height)):
        h = np.float32(0.5) if y == row else np.float32(0.25)
        add_weighted(columns[1:-1], inside[1:-1], h, signals[y, s, 3], surfaces[y, 3])
    colour = signals[row, s, 0], signals[row, s, 1], signals[row, s, 2]
    finish_edge(signals[row, s, 4], signals[row, s, 5], *colour, columns, inside)


@jit_parallel
def edge_image(signals: Any, surfaces: Any) -> None:
    for row in numba.prange(len(signals)):
        for s in range(signals.shape[1]):
            edge_row(signals, surfaces, np.int64(row), s)


@jit_in_any_order
def pack(line: Any, margin: int, values: Any) -> None:
    """A line from values without margins."""
    line[:margin] = 0
    copy_line(line[margin : line.size - margin], values)
    line[line.size - margin :] = 0


@jit_with_memory
def pack_row(row: Any, signals: Any, surfaces: Any, margin: int, colour: Any, variance: Any, geometry: Any) -> None:
    """The row's lines, signals (S, SIGNAL, W) and surfaces (GEOMETRY, W).

    From colour (S, 3, H, W), variance (S, H, W), geometry (GEOMETRY, H, W).
    """
    for line in range(GEOMETRY):
        pack(surfaces[line], margin, geometry[line, row])
    for s in range(len(signals)):
        for c in range(3):
            pack(signals[s, c], margin, colour[s, c, row])
        pack(signals[s, 3], margin, variance[s, row])


@jit_parallel
def pack_rows(
    signals: Any, filtered: Any, surfaces: Any, margin: int, colour: Any, variance: Any, geometry: Any
) -> None:
    """All rows; and no light in the margins of `filtered`."""
    for row in numba.prange(len(signals)):
        pack_row(np.int64(row), signals[row], surfaces[row], margin, colour, variance, geometry)
        filtered[row, :, :, :margin] = 0
        filtered[row, :, :, filtered.shape[-1] - margin :] = 0


def planes_of(signals: NDArray[np.float32], margin: int) -> Tensor:
    """Signals without their margins, (S, SIGNAL, H, W)."""
    return torch.from_numpy(signals[..., margin:-margin]).permute(1, 2, 0, 3)


def svgf_levels(
    colour: Tensor, variance: Tensor, geometry: Tensor, steps: Sequence[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """See models.filters.svgf.svgf_levels."""
    count_signals, _, height, width = colour.shape[1:]
    margin = RADIUS * max(steps)
    first = torch.empty_like(colour, memory_format=torch.contiguous_format)
    last = torch.empty_like(first)
    spread = torch.empty_like(variance, memory_format=torch.contiguous_format)
    signals, filtered = np.empty((2, height, count_signals, SIGNAL, width + 2 * margin), np.float32)
    surfaces = np.empty((height, GEOMETRY, width + 2 * margin), np.float32)
    for item in range(len(colour)):
        images = array(colour[item]), array(variance[item, :, 0]), array(geometry[item, 0])
        pack_rows(signals, filtered, surfaces, margin, *images)
        for level, step in enumerate(steps):
            edge_image(signals, surfaces)
            filter_image(filtered, signals, surfaces, margin, step)
            signals, filtered = filtered, signals
            if level == 0:
                first[item] = planes_of(signals, margin)[:, :3]
        last[item] = planes_of(signals, margin)[:, :3]
        spread[item] = planes_of(signals, margin)[:, 3:4]
    return first, last, spread


# --- The spatial estimate of variance ---------------------------------------------------------------------------------


@jit_in_any_order
def add_spatial_tap(
    sums: Any, first: Any, weight: Any, variance: Any, mean: Any, row: Any, left: int, dx: int, dy: int
) -> None:
    """Add one tap of the n pixels from `left` on to sums (3, SPATIAL_BLOCK), which begin with the pixel at `first`.

    Of weights, of means less the centre's, of their squares plus variances.
    """
    right = left + weight.size
    to = row + dy
    to_left = left + dx
    to_right = right + dx
    start = left - first
    stop = right - first
    total = sums[0, start:stop]
    means = sums[1, start:stop]
    squares = sums[2, start:stop]
    centre = mean[row, left:right]
    there = mean[to, to_left:to_right]
    v = variance[to, to_left:to_right]
    for i in range(weight.size):
        off = there[i] - centre[i]
        total[i] += weight[i]
        means[i] += weight[i] * off
        squares[i] += weight[i] * (off * off + v[i])


@jit_with_memory
def sum_spatial_block(sums: Any, row: Any, first: Any, last: Any, variance: Any, mean: Any, geometry: Any) -> None:
    """sums (S, 3, SPATIAL_BLOCK) over the windows of the pixels `first` to `last` - 1 of a row.

    variance, mean (S, H, W).
    """
    signals, height, width = variance.shape
    space = np.empty(SPATIAL_BLOCK, np.float32)
    sums[:, 0] = 1
    sums[:, 1] = 0
    sums[:, 2, : last - first] = variance[:, row, first:last]
    for dy in range(max(-SPATIAL_RADIUS, -row), min(SPATIAL_RADIUS + 1, height - row)):
        for dx in range(-SPATIAL_RADIUS, SPATIAL_RADIUS + 1):
            left = max(first, -dx)
            right = min(last, width - dx)
            if (dx == 0 and dy == 0) or left >= right:
                continue
            weight = space[: right - left]
            geometry_weights(weight, geometry, row, left, dx, dy)
            for s in range(signals):
                add_spatial_tap(sums[s], first, weight, variance[s], mean[s], row, left, dx, dy)


@jit_with_memory
def spatial_variance_row(out: Any, row: Any, variance: Any, mean: Any, geometry: Any, where: Any) -> None:
    """A row of out (S, H, W) `where` (H, W) it is wanted."""
    signals, _, width = variance.shape
    sums = np.empty((signals, 3, SPATIAL_BLOCK), np.float32)
    for first in range(0, width, SPATIAL_BLOCK):
        last = min(first + SPATIAL_BLOCK, width)
        if not where[row, first:last].any():
            continue
        sum_spatial_block(sums, row, first, last, variance, mean, geometry)
        for s in range(signals):
            for x in range(first, last):
                if where[row, x]:
                    total = sums[s, 0, x - first]
                    means = sums[s, 1, x - first]
                    squares = sums[s, 2, x - first]
                    out[s, row, x] = max(squares / total - (means / total) ** 2, np.float32(0))


@jit_parallel
def spatial_variance_image(out: Any, variance: Any, mean: Any, geometry: Any, where: Any) -> None:
    for row in numba.prange(variance.shape[1]):
        spatial_variance_row(out, np.int64(row), variance, mean, geometry, where)


def spatial_variance(variance: Tensor, mean: Tensor, geometry: Tensor, where: Tensor) -> Tensor:
    """See models.filters.svgf.spatial_variance."""
    out = variance.clone(memory_format=torch.contiguous_format)
    for item in range(len(variance)):
        images = array(variance[item, :, 0]), array(mean[item, :, 0]), array(geometry[item, 0])
        spatial_variance_image(out[item, :, 0].numpy(), *images, where[item, 0].numpy())
    return out
