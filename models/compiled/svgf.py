"""models.filters.svgf for the CPU: rows in parallel, every loop along them vectorised.

Slices along the last dimension have names of their own in the innermost functions: Numba knows that they are
contiguous, unlike rows of a slice in two dimensions. Scratch memory is flat, with offsets that are constants: LLVM
vectorises a loop only where few comparisons show that no output overlaps an input.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.frame import Frame
from models.compiled.accumulation import weigh
from models.compiled.arrays import RGB, Image, Index, Mask, Plane, Row, Scalar, Signals, f32
from models.compiled.exponential import exp
from models.compiled.jit import array, jit_in_any_order, jit_inlined_in_any_order, jit_parallel, jit_with_reciprocals
from models.compiled.lines import block_count, copy_line, luminance, rows_of_block, triple, triple_of_lines, window_taps
from models.compiled.reprojection import FramePair, find_taps, gather, new_taps
from models.filters.atrous import RADIUS, SPLINE
from models.operators import MAX_LUMINANCE, MIN_DIVISOR

if TYPE_CHECKING:
    from models.filters.svgf import Integrated

SPATIAL_RADIUS = 3  # §4.2: windows of 7 x 7
SIGMA_Z = 1.0  # §4.4
SIGMA_L = 4.0
SQUARINGS = 7  # σ_n = 128 = 2^7
EPSILON_Z = 1e-3  # of the depth
EPSILON_L = 1e-20  # luminance²

unsigned = np.uint64  # indices that cannot be negative: NumPy counts those from the end, which keeps loops scalar
NEGLIGIBLE_COSINE = np.float32(0.79)  # to the 128th it is 8e-14
NEGLIGIBLE_WEIGHT = np.float32(1e-15)
NEGLIGIBLE_EXPONENT = np.float32(40)  # e^-40 is below NEGLIGIBLE_WEIGHT
MIN_GAUSSIAN_SHARE = np.float32(1 / 16)  # of one pixel in a Gaussian of 3 x 3
VARIANCE_TAPS = 2 * RADIUS + 1  # of a row
LEVEL_BLOCK = 256  # px; so many of a row are filtered together, and what they need stays in the first cache
GEOMETRY = 7  # channels of pack_geometry: unit normal (3), depth, σ_z ∇z (2), tolerance
SIGNAL = 6  # channels of a signal: red, green, blue, variance, luminance, edge_scale
SPATIAL_BLOCK = 64  # px; the spatial estimate is made for all of a block where one needs it


# --- Temporal integration ---------------------------------------------------------------------------------------------


# Of one item of models.filters.svgf.Integrated: colour (S, 3, H, W), moments (S, 2, H, W), length (H, W).
IntegratedArrays: TypeAlias = tuple[Signals, Signals, Plane]


@jit_with_reciprocals
def luminance_moments(first: Row, second: Row, colour: RGB) -> None:
    """The clamped luminance and its square."""
    red, green, blue = colour
    for x in range(first.size):
        y = min(max(luminance(red[x], green[x], blue[x]), -f32(MAX_LUMINANCE)), f32(MAX_LUMINANCE))
        first[x] = y
        second[x] = y * y


@jit_with_reciprocals
def blend(line: Row, past: Row, new: Row, alpha: Row, valid: Row) -> None:
    for x in range(line.size):
        line[x] = past[x] + alpha[x] * (new[x] - past[x]) if valid[x] > 0 else new[x]


@jit_parallel
def integrate_image(
    out: IntegratedArrays, noisy: Signals, past: IntegratedArrays, change: Plane, pair: FramePair
) -> None:
    """`change` (H, W) of the history is dropped; it is empty for none."""
    colour, moments, length = out
    past_colour, past_moments, past_length = past
    signals, _, height, width = noisy.shape
    for block in numba.prange(block_count(height)):
        taps = new_taps(width)
        gathered = np.empty(width, np.float32)
        new = np.empty((2, width), np.float32)
        alpha = np.empty(width, np.float32)
        none = np.zeros(width, np.float32)
        for y in rows_of_block(block, height):
            find_taps(taps, y, pair)
            gather(gathered, past_length, y, taps)
            weigh(alpha, length[y], gathered, change[y] if change.size > 0 else none, taps.valid)
            for s in range(signals):
                for c in range(3):
                    gather(gathered, past_colour[s, c], y, taps)
                    blend(colour[s, c, y], gathered, noisy[s, c, y], alpha, taps.valid)
                luminance_moments(new[0], new[1], triple(noisy[s], y, 0, width))
                for c in range(2):
                    gather(gathered, past_moments[s, c], y, taps)
                    blend(moments[s, c, y], gathered, new[c], alpha, taps.valid)


def integrate_samples(
    frame: Frame, noisy: Tensor, previous: "Integrated", change: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    images = noisy, previous.moments, previous.length
    colour, moments, length = (torch.empty_like(image, memory_format=torch.contiguous_format) for image in images)
    for item in range(len(noisy)):
        out = colour[item].numpy(), moments[item].numpy(), length[item, 0].numpy()
        past = array(previous.colour[item]), array(previous.moments[item]), array(previous.length[item, 0])
        dropped = np.empty((0, 0), np.float32) if change is None else array(change[item, 0])
        integrate_image(out, array(noisy[item]), past, dropped, FramePair.of(frame, previous.gbuffer, item))
    return colour, moments, length


# --- What stops the filters at edges of surfaces ----------------------------------------------------------------------


@jit_in_any_order
def nearer_to_zero(a: np.float32, b: np.float32) -> np.float32:
    """Whichever is nearer to 0; 0 where both are infinite."""
    nearer = a if abs(a) < abs(b) else b
    return nearer if abs(nearer) < np.inf else f32(0)


@jit_in_any_order
def depth_steps(step: Row, depth: Row, to_depth: Row, mesh: Row, to_mesh: Row) -> None:
    """step (n): change of depth to the neighbours, infinite where they are on another mesh."""
    for i in range(step.size):
        step[i] = to_depth[i] - depth[i] if mesh[i] == to_mesh[i] else f32(np.inf)


@jit_parallel
def pack_geometry_image(packed: Image, depth: Plane, normal: Image, mesh: Plane) -> None:
    """packed (GEOMETRY, H, W): unit normal, depth z, σ_z ∇z, ε_z |z|."""
    height, width = depth.shape
    for number in numba.prange(height):
        row = np.int64(number)
        z = depth[row]
        here = mesh[row]
        ahead = np.full(width, f32(np.inf))
        behind = np.full(width, f32(np.inf))
        across = np.full(width + 1, f32(np.inf))
        if row + 1 < height:
            depth_steps(ahead, z, depth[row + 1], here, mesh[row + 1])
        if row > 0:
            depth_steps(behind, depth[row - 1], z, mesh[row - 1], here)
        depth_steps(across[1:width], z[:-1], z[1:], here[:-1], here[1:])
        x, y, n_z = triple(normal, row, 0, width)
        out_x, out_y, out_z = triple(packed, row, 0, width)
        out_depth, along_x, along_y, tolerance = packed[3, row], packed[4, row], packed[5, row], packed[6, row]
        for i in range(width):
            length = np.sqrt(x[i] * x[i] + y[i] * y[i] + n_z[i] * n_z[i])
            normalise = f32(1) / max(length, f32(MIN_DIVISOR)) if z[i] > 0 else f32(0)
            out_x[i] = x[i] * normalise
            out_y[i] = y[i] * normalise
            out_z[i] = n_z[i] * normalise
            out_depth[i] = z[i]
            along_x[i] = f32(SIGMA_Z) * nearer_to_zero(across[i + 1], across[i])
            along_y[i] = f32(SIGMA_Z) * nearer_to_zero(ahead[i], behind[i])
            tolerance[i] = f32(EPSILON_Z) * abs(z[i]) + f32(MIN_DIVISOR)


def pack_geometry(depth: Tensor, normal: Tensor, mesh_id: Tensor) -> Tensor:
    packed = depth.new_empty(len(depth), 1, GEOMETRY, *depth.shape[-2:])
    for item in range(len(depth)):
        images = array(depth[item, 0]), array(normal[item]), array(mesh_id[item, 0])
        pack_geometry_image(packed[item, 0].numpy(), *images)
    return packed


@jit_inlined_in_any_order
def geometry_terms(
    here: tuple[np.float32, ...], there: tuple[np.float32, ...], dx: Scalar, dy: Scalar
) -> tuple[Scalar, Scalar]:
    """Eq. 3 and 4 as w_n = (n · n')^σ_n, and exponent = |z - z'| / (|σ_z ∇z · (dx, dy)| + tolerance).

    `here` has the channels of pack_geometry, `there` the first four.
    """
    x, y, z, depth, along_x, along_y, tolerance = here
    to_x, to_y, to_z, to_depth = there
    w_n = x * to_x + y * to_y + z * to_z
    w_n = w_n if w_n > NEGLIGIBLE_COSINE else f32(0)
    for _ in range(SQUARINGS):
        w_n *= w_n
    return w_n, abs(depth - to_depth) / (abs(along_x * dx + along_y * dy) + tolerance)


@jit_inlined_in_any_order
def weight(w: Scalar, exponent: Scalar) -> Scalar:
    """w exp(-exponent), 0 where that is negligible: denormal numbers are slow."""
    w *= exp(-min(exponent, NEGLIGIBLE_EXPONENT))
    return w if w > NEGLIGIBLE_WEIGHT else f32(0)


@jit_in_any_order
def geometry_weights(weights: Row, geometry: Image, row: Index, left: Index, dx: Index, dy: Index) -> None:
    """As weights (n) filters.svgf.geometry_weight of the n pixels from `left` on in a row of the geometry (7, H, W)."""
    right = left + weights.size
    to = row + dy
    x, y, z = triple(geometry, row, left, right)
    to_x, to_y, to_z = triple(geometry, to, left + dx, right + dx)
    depth, to_depth = geometry[3, row, left:right], geometry[3, to, left + dx : right + dx]
    along_x, along_y = geometry[4, row, left:right], geometry[5, row, left:right]
    tolerance = geometry[6, row, left:right]
    for i in range(weights.size):
        here = (x[i], y[i], z[i], depth[i], along_x[i], along_y[i], tolerance[i])
        there = (to_x[i], to_y[i], to_z[i], to_depth[i])
        w, exponent = geometry_terms(here, there, f32(dx), f32(dy))
        weights[i] = weight(w, exponent)


# --- The à-trous transform --------------------------------------------------------------------------------------------
#
# All taps of a row are taken at once, so that a pixel's own values and its sums stay in registers for five taps. Taps
# read two arrays, which lie row by row: `surfaces` (H, GEOMETRY, W) and `signals` (H, S, SIGNAL, W). On either side is
# a margin of background, which has no weight, so that no tap has to be tested for being inside the image.


# (row, to, step, first, size): pixels `first` to `first + size` - 1 of a row, whose taps are in the row `to`, `step`
# pixels apart.
TapRow: TypeAlias = tuple[Index, Index, int, Index, Index]


@jit_in_any_order
def weigh_taps(weights: Row, h: Row, surfaces: Image, taps: TapRow) -> None:
    """weights (2 * VARIANCE_TAPS * LEVEL_BLOCK): of each tap h times w_n, and the exponent, of geometry_terms."""
    row, to, step, first, count = taps
    x, y, z = surfaces[row, 0], surfaces[row, 1], surfaces[row, 2]
    depth, along_x, along_y, tolerance = surfaces[row, 3], surfaces[row, 4], surfaces[row, 5], surfaces[row, 6]
    to_x, to_y, to_z, to_depth = surfaces[to, 0], surfaces[to, 1], surfaces[to, 2], surfaces[to, 3]
    dy = f32(to - row)
    for i in range(count):
        p = unsigned(first + i)
        here = (x[p], y[p], z[p], depth[p], along_x[p], along_y[p], tolerance[p])
        for tap in range(VARIANCE_TAPS):
            dx = (tap - RADIUS) * step
            q = unsigned(first + i + dx)
            w_n, exponent = geometry_terms(here, (to_x[q], to_y[q], to_z[q], to_depth[q]), f32(dx), dy)
            weights[unsigned(2 * tap * LEVEL_BLOCK + i)] = h[tap] * w_n
            weights[unsigned((2 * tap + 1) * LEVEL_BLOCK + i)] = exponent


@jit_in_any_order
def add_taps(sums: Row, weights: Row, signals: Signals, s: int, taps: TapRow) -> None:
    """Add all taps of signal s, with the weights of weigh_taps, to sums (5 * LEVEL_BLOCK).

    Of colours, w c; of variances, w² v; of weights, w = w_z w_n exp(-|y - y'| / (σ_l √g(Var))) (Eq. 5).
    """
    row, to, step, first, count = taps
    r, g, b = signals[to, s, 0], signals[to, s, 1], signals[to, s, 2]
    v, to_y = signals[to, s, 3], signals[to, s, 4]
    y, scale = signals[row, s, 4], signals[row, s, 5]
    for i in range(count):
        p = unsigned(first + i)
        red = green = blue = spread = total = f32(0)
        for tap in range(VARIANCE_TAPS):
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
def divide_sums(filtered: Signals, signals: Signals, row: Index, s: int, first: Index, count: Index, sums: Row) -> None:
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
        normalise = f32(1) / (sums[unsigned(i + 4 * LEVEL_BLOCK)] + h)
        line[p] = (sums[unsigned(i + 3 * LEVEL_BLOCK)] + h * h * centre[p]) * normalise * normalise


@jit_parallel
def filter_image(filtered: Signals, signals: Signals, surfaces: Image, margin: int, step: int) -> None:
    """Colour and variance of `filtered`, as `signals`, by one level with taps `step` pixels apart."""
    height, count_signals, _, width = signals.shape
    for number in numba.prange(height):
        row = np.int64(number)
        sums = np.empty((count_signals, 5 * LEVEL_BLOCK), np.float32)
        weights = np.empty(2 * VARIANCE_TAPS * LEVEL_BLOCK, np.float32)
        h = np.empty(VARIANCE_TAPS, np.float32)
        for first in range(margin, width - margin, LEVEL_BLOCK):
            count = min(LEVEL_BLOCK, width - margin - first)
            sums[:] = 0
            for j in range(-RADIUS, RADIUS + 1):
                to = row + j * step
                if to < 0 or to >= height:
                    continue
                h[:] = SPLINE[j + RADIUS] * SPLINE
                if j == 0:
                    h[RADIUS] = 0  # the pixel itself, which divide_sums adds
                taps = (row, to, step, first, count)
                weigh_taps(weights, h, surfaces, taps)
                for s in range(count_signals):
                    add_taps(sums[s], weights, signals, s, taps)
            for s in range(count_signals):
                divide_sums(filtered, signals, row, s, first, count, sums[s])


@jit_in_any_order
def add_surfaces(total: Row, weight: Row, h: Scalar, variance: Row, depth: Row) -> None:
    """Add h times the variance, and h, of pixels that show a surface."""
    for x in range(total.size):
        share = h if depth[x] > 0 else f32(0)
        total[x] += share * variance[x]
        weight[x] += share


@jit_in_any_order
def finish_edge(y: Row, scale: Row, colour: RGB, columns: Row, inside: Row) -> None:
    """Luminance y, and 1 / (σ_l √(g(Var) + ε)) of Eq. 5, from weighted sums of columns: of variances, of weights."""
    r, g, b = colour
    for x in range(scale.size):
        y[x] = luminance(r[x], g[x], b[x])
        mean = f32(0.25) * columns[x] + f32(0.5) * columns[x + 1] + f32(0.25) * columns[x + 2]
        share = f32(0.25) * inside[x] + f32(0.5) * inside[x + 1] + f32(0.25) * inside[x + 2]
        scale[x] = f32(1) / (f32(SIGMA_L) * np.sqrt(mean / max(share, MIN_GAUSSIAN_SHARE) + f32(EPSILON_L)))


@jit_parallel
def edge_image(signals: Signals, surfaces: Image) -> None:
    """Fill in luminance and models.filters.svgf.edge_scale."""
    height, count_signals, _, width = signals.shape
    for number in numba.prange(height):
        row = np.int64(number)
        for s in range(count_signals):
            columns = np.zeros(width + 2, np.float32)
            inside = np.zeros(width + 2, np.float32)
            for y in (row - 1, row, row + 1):
                if 0 <= y < height:
                    h = f32(0.5) if y == row else f32(0.25)
                    add_surfaces(columns[1:-1], inside[1:-1], h, signals[y, s, 3], surfaces[y, 3])
            colour = signals[row, s, 0], signals[row, s, 1], signals[row, s, 2]
            finish_edge(signals[row, s, 4], signals[row, s, 5], colour, columns, inside)


@jit_in_any_order
def pad(line: Row, margin: int, values: Row) -> None:
    line[:margin] = 0
    copy_line(line[margin : line.size - margin], values)
    line[line.size - margin :] = 0


@jit_parallel
def pack_rows(
    signals: Signals, filtered: Signals, surfaces: Image, colour: Signals, variance: Image, geometry: Image
) -> None:
    """Fill signals and surfaces, from colour (S, 3, H, W), variance (S, H, W) and geometry (GEOMETRY, H, W)."""
    margin = (signals.shape[-1] - colour.shape[-1]) // 2
    for number in numba.prange(len(signals)):
        row = np.int64(number)
        for line in range(GEOMETRY):
            pad(surfaces[row, line], margin, geometry[line, row])
        for s in range(signals.shape[1]):
            for c in range(3):
                pad(signals[row, s, c], margin, colour[s, c, row])
            pad(signals[row, s, 3], margin, variance[s, row])
        filtered[row, :, :, :margin] = 0
        filtered[row, :, :, filtered.shape[-1] - margin :] = 0


def planes_of(signals: Signals, margin: int) -> Tensor:
    """Signals without their margins, (S, SIGNAL, H, W)."""
    return torch.from_numpy(signals[..., margin:-margin]).permute(1, 2, 0, 3)


def svgf_levels(
    colour: Tensor, variance: Tensor, geometry: Tensor, steps: Sequence[int]
) -> tuple[Tensor, Tensor, Tensor]:
    count_signals, _, height, width = colour.shape[1:]
    margin = RADIUS * max(steps)
    first = torch.empty_like(colour, memory_format=torch.contiguous_format)
    last = torch.empty_like(first)
    spread = torch.empty_like(variance, memory_format=torch.contiguous_format)
    signals, filtered = np.empty((2, height, count_signals, SIGNAL, width + 2 * margin), np.float32)
    surfaces = np.empty((height, GEOMETRY, width + 2 * margin), np.float32)
    for item in range(len(colour)):
        images = array(colour[item]), array(variance[item, :, 0]), array(geometry[item, 0])
        pack_rows(signals, filtered, surfaces, *images)
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
def add_spatial_tap(sums: RGB, weight: Row, centre: Row, mean: Row, variance: Row) -> None:
    """Add one tap to the sums of weights, of means less the centre's, of their squares plus variances."""
    total, means, squares = sums
    for i in range(weight.size):
        off = mean[i] - centre[i]
        total[i] += weight[i]
        means[i] += weight[i] * off
        squares[i] += weight[i] * (off * off + variance[i])


@jit_in_any_order
def sum_spatial_block(
    sums: Image, space: Row, row: Index, first: Index, last: Index, variance: Image, mean: Image, geometry: Image
) -> None:
    """sums (S, 3, SPATIAL_BLOCK) over the windows of the pixels `first` to `last` - 1 of a row of (S, H, W).

    space (SPATIAL_BLOCK) is scratch.
    """
    signals, height, width = variance.shape
    for s in range(signals):
        sums[s, 0] = 1
        sums[s, 1] = 0
        copy_line(sums[s, 2, : last - first], variance[s, row, first:last])
    for dx, dy, inside, outside in window_taps(row, SPATIAL_RADIUS, 1, height, width):
        left = max(inside, first)
        right = min(outside, last)
        if (dx == 0 and dy == 0) or left >= right:
            continue
        weight = space[: right - left]
        geometry_weights(weight, geometry, row, left, dx, dy)
        there = slice(left + dx, right + dx)
        for s in range(signals):
            to = triple_of_lines(sums[s], left - first, right - first)
            centre, noise = mean[s, row, left:right], variance[s, row + dy, there]
            add_spatial_tap(to, weight, centre, mean[s, row + dy, there], noise)


@jit_parallel
def spatial_variance_image(out: Image, variance: Image, mean: Image, geometry: Image, where: Mask) -> None:
    """out (S, H, W) `where` (H, W) it is wanted."""
    signals, height, width = variance.shape
    for number in numba.prange(height):
        row = np.int64(number)
        sums = np.empty((signals, 3, SPATIAL_BLOCK), np.float32)
        space = np.empty(SPATIAL_BLOCK, np.float32)
        for first in range(0, width, SPATIAL_BLOCK):
            last = min(first + SPATIAL_BLOCK, width)
            if not where[row, first:last].any():
                continue
            sum_spatial_block(sums, space, row, first, last, variance, mean, geometry)
            for s in range(signals):
                for x in range(first, last):
                    if where[row, x]:
                        total, means, squares = sums[s, 0, x - first], sums[s, 1, x - first], sums[s, 2, x - first]
                        out[s, row, x] = max(squares / total - (means / total) ** 2, f32(0))


def spatial_variance(variance: Tensor, mean: Tensor, geometry: Tensor, where: Tensor) -> Tensor:
    out = variance.clone(memory_format=torch.contiguous_format)
    for item in range(len(variance)):
        images = array(variance[item, :, 0]), array(mean[item, :, 0]), array(geometry[item, 0])
        spatial_variance_image(out[item, :, 0].numpy(), *images, where[item, 0].numpy())
    return out
