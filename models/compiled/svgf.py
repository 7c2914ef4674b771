"""models.svgf for the processor: every row by itself, every loop along it vectorised.

Each line of memory has a name of its own in the innermost functions: Numba knows slices along the last dimension as
contiguous, unlike lines of a slice in two dimensions.
"""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.channels import LUMINANCE_WEIGHTS
from datasets.frame import Frame
from models import parameters
from models.atrous import RADIUS
from models.compiled.atrous import SPLINE, columns_with_tap, decay
from models.compiled.jit import (
    array,
    jit_in_any_order,
    jit_parallel,
    jit_with_memory,
    jit_with_reciprocals,
    plane_or_empty,
)
from models.compiled.reprojection import BLOCK_ROWS, ONE, Buffers, Past, Views, fetch, find_row, new_search
from models.parameters import SPATIAL_RADIUS, SQUARINGS
from models.surfaces import Surfaces

RED_WEIGHT, GREEN_WEIGHT, BLUE_WEIGHT = (np.float32(weight) for weight in LUMINANCE_WEIGHTS)
ALPHA = np.float32(parameters.ALPHA)
LARGEST_LUMINANCE = np.float32(parameters.LARGEST_LUMINANCE)
SIGMA_Z = np.float32(parameters.SIGMA_Z)
SIGMA_L = np.float32(parameters.SIGMA_L)
EPSILON_Z = np.float32(parameters.EPSILON_Z)
EPSILON_L = np.float32(parameters.EPSILON_L)
LEAST_DIVISOR = np.float32(parameters.LEAST_DIVISOR)
LEAST_COSINE = np.float32(0.79)  # to the 128th it is 8e-14
LEAST_WEIGHT = np.float32(1e-15)
LEAST_SHARE = np.float32(1 / 16)  # of one pixel in a Gaussian of 3 x 3
SPATIAL_BLOCK = 64  # px; the spatial estimate is made for all of a block where one needs it


# --- Temporal integration ---------------------------------------------------------------------------------------------


@jit_with_reciprocals
def clamp_luminance(y: Any, red: Any, green: Any, blue: Any) -> None:
    for x in range(y.size):
        luminance = RED_WEIGHT * red[x] + GREEN_WEIGHT * green[x] + BLUE_WEIGHT * blue[x]
        y[x] = min(max(luminance, -LARGEST_LUMINANCE), LARGEST_LUMINANCE)


@jit_with_reciprocals
def square(line: Any, y: Any) -> None:
    for x in range(line.size):
        line[x] = y[x] * y[x]


@jit_with_reciprocals
def weigh(alpha: Any, length: Any, past_length: Any, change: Any, found: Any) -> None:
    """The weight of the newest frame and the new history length, (W), where `change` of the history is given up."""
    for x in range(alpha.size):
        kept = ONE - change[x]
        alpha[x] = kept * ALPHA + change[x]
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
    surfaces: Surfaces,
    change: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """See models.svgf.integrate_samples."""
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
            *Past.of(frame, surfaces, item),
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
        normalise = np.float32(1) / max(length, LEAST_DIVISOR) if z[i] > 0 else np.float32(0)
        out_x[i] = x[i] * normalise
        out_y[i] = y[i] * normalise
        out_z[i] = n_z[i] * normalise
        out_depth[i] = z[i]
        along_x[i] = SIGMA_Z * nearer_to_zero(across[i + 1], across[i])
        along_y[i] = SIGMA_Z * nearer_to_zero(ahead[i], behind[i])
        tolerance[i] = EPSILON_Z * abs(z[i]) + LEAST_DIVISOR


@jit_parallel
def pack_geometry_image(packed: Any, depth: Any, normal: Any, mesh: Any) -> None:
    for row in numba.prange(depth.shape[0]):
        pack_geometry_row(packed, np.int64(row), depth, normal, mesh)


def pack_geometry(depth: Tensor, normal: Tensor, mesh_id: Tensor) -> Tensor:
    """See models.svgf.pack_geometry."""
    packed = depth.new_empty(len(depth), 1, 7, *depth.shape[-2:])
    for item in range(len(depth)):
        pack_geometry_image(
            packed[item, 0].numpy(), array(depth[item, 0]), array(normal[item]), array(mesh_id[item, 0])
        )
    return packed


@jit_in_any_order
def geometry_weights(weight: Any, exponent: Any, geometry: Any, row: Any, left: int, dx: int, dy: int) -> None:
    """models.svgf.geometry_weight of the n pixels from `left` on in a row of the geometry (7, H, W).

    As weight (n) times e to the power of -exponent (n).
    """
    right = left + weight.size
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
    for i in range(weight.size):
        w_n = x[i] * to_x[i] + y[i] * to_y[i] + z[i] * to_z[i]
        w_n = w_n if w_n > LEAST_COSINE else np.float32(0)
        for _ in range(SQUARINGS):
            w_n *= w_n
        expected = abs(along_x[i] * by_x + along_y[i] * by_y) + tolerance[i]
        weight[i] = w_n
        exponent[i] = abs(depth[i] - to_depth[i]) / expected


@jit_in_any_order
def apply_exponents(weight: Any, exponent: Any) -> None:
    for i in range(weight.size):
        w = weight[i] * decay(exponent[i])
        weight[i] = w if w > LEAST_WEIGHT else np.float32(0)


# --- A level of the à-trous transform ---------------------------------------------------------------------------------


@jit_in_any_order
def add_svgf_tap(
    sums: Any,
    h: Any,
    weight: Any,
    exponent: Any,
    colour: Any,
    variance: Any,
    edge: Any,
    row: Any,
    left: int,
    dx: int,
    dy: int,
) -> None:
    """Add one tap of the n pixels from `left` on in a row to sums (5, W): of weights, of colours, of variances.

    weight and exponent (n) are geometrical; colour (3, H, W), variance (H, W), edge (2, H, W): luminance and its scale.
    """
    right = left + weight.size
    to = row + dy
    to_left = left + dx
    to_right = right + dx
    total = sums[0, left:right]
    red = sums[1, left:right]
    green = sums[2, left:right]
    blue = sums[3, left:right]
    spread = sums[4, left:right]
    r = colour[0, to, to_left:to_right]
    g = colour[1, to, to_left:to_right]
    b = colour[2, to, to_left:to_right]
    v = variance[to, to_left:to_right]
    y = edge[0, row, left:right]
    to_y = edge[0, to, to_left:to_right]
    scale = edge[1, row, left:right]
    for i in range(weight.size):
        w = h * weight[i] * decay(abs(y[i] - to_y[i]) * scale[i] + exponent[i])
        w = w if w > LEAST_WEIGHT else np.float32(0)
        total[i] += w
        red[i] += w * r[i]
        green[i] += w * g[i]
        blue[i] += w * b[i]
        spread[i] += w * w * v[i]


@jit_with_memory
def sum_svgf_row(sums: Any, row: Any, step: int, colour: Any, variance: Any, edge: Any, geometry: Any) -> None:
    """sums (S, 5, W) over the taps of one row of colour (S, 3, H, W), variance (S, H, W), edge (S, 2, H, W)."""
    signals, _, height, width = colour.shape
    space = np.empty((2, width), np.float32)
    h = SPLINE[RADIUS] * SPLINE[RADIUS]
    for s in range(signals):
        sums[s, 0] = h
        sums[s, 1:4] = h * colour[s, :, row]
        sums[s, 4] = h * h * variance[s, row]
    for j in range(-RADIUS, RADIUS + 1):
        for i in range(-RADIUS, RADIUS + 1):
            dx = i * step
            dy = j * step
            left, right = columns_with_tap(row, dx, dy, height, width)
            if left >= right:
                continue
            h = SPLINE[j + RADIUS] * SPLINE[i + RADIUS]
            weight = space[0, : right - left]
            exponent = space[1, : right - left]
            geometry_weights(weight, exponent, geometry, row, left, dx, dy)
            for s in range(signals):
                add_svgf_tap(sums[s], h, weight, exponent, colour[s], variance[s], edge[s], row, left, dx, dy)


@jit_in_any_order
def divide_svgf_row(colour: Any, variance: Any, row: Any, sums: Any) -> None:
    """A row of colour (3, H, W) and of variance (H, W) from sums (5, W)."""
    r = colour[0, row]
    g = colour[1, row]
    b = colour[2, row]
    v = variance[row]
    total = sums[0]
    red = sums[1]
    green = sums[2]
    blue = sums[3]
    spread = sums[4]
    for i in range(total.size):
        normalise = np.float32(1) / total[i]
        r[i] = red[i] * normalise
        g[i] = green[i] * normalise
        b[i] = blue[i] * normalise
        v[i] = spread[i] * normalise * normalise


@jit_parallel
def filter_svgf_image(
    colour_out: Any, variance_out: Any, colour: Any, variance: Any, edge: Any, geometry: Any, step: int
) -> None:
    signals, _, height, width = colour.shape
    for row in numba.prange(height):
        sums = np.empty((signals, 5, width), np.float32)
        sum_svgf_row(sums, np.int64(row), step, colour, variance, edge, geometry)
        for s in range(signals):
            divide_svgf_row(colour_out[s], variance_out[s], row, sums[s])


@jit_with_memory
def edge_row(edge: Any, colour: Any, variance: Any, depth: Any, row: Any) -> None:
    """A row of edge (2, H, W): luminance of colour (3, H, W), and models.svgf.edge_scale of variance (H, W)."""
    height, width = variance.shape
    quarter = np.float32(0.25)
    half = np.float32(0.5)
    columns = np.zeros(width + 2, np.float32)
    inside = np.zeros(width + 2, np.float32)
    total = columns[1:-1]
    weight = inside[1:-1]
    for y in range(max(row - 1, 0), min(row + 2, height)):
        h = half if y == row else quarter
        line = variance[y]
        z = depth[y]
        for x in range(width):
            share = h if z[x] > 0 else np.float32(0)
            total[x] += share * line[x]
            weight[x] += share
    r = colour[0, row]
    g = colour[1, row]
    b = colour[2, row]
    luminance = edge[0, row]
    scale = edge[1, row]
    for x in range(width):
        luminance[x] = RED_WEIGHT * r[x] + GREEN_WEIGHT * g[x] + BLUE_WEIGHT * b[x]
        mean = quarter * columns[x] + half * columns[x + 1] + quarter * columns[x + 2]
        share = quarter * inside[x] + half * inside[x + 1] + quarter * inside[x + 2]
        mean /= max(share, LEAST_SHARE)
        scale[x] = np.float32(1) / (SIGMA_L * np.sqrt(mean + EPSILON_L))


@jit_parallel
def edge_image(edge: Any, colour: Any, variance: Any, geometry: Any) -> None:
    signals, height, _ = variance.shape
    for row in numba.prange(height):
        for s in range(signals):
            edge_row(edge[s], colour[s], variance[s], geometry[3], np.int64(row))


def svgf_level(colour: Tensor, variance: Tensor, geometry: Tensor, step: int) -> tuple[Tensor, Tensor]:
    """See models.svgf.svgf_level."""
    filtered = torch.empty_like(colour, memory_format=torch.contiguous_format)
    spread = torch.empty_like(variance, memory_format=torch.contiguous_format)
    edge = np.empty((colour.shape[1], 2, *colour.shape[-2:]), np.float32)
    for item in range(len(colour)):
        image = array(colour[item]), array(variance[item, :, 0])
        surfaces = array(geometry[item, 0])
        edge_image(edge, *image, surfaces)
        out = filtered[item].numpy(), spread[item, :, 0].numpy()
        filter_svgf_image(*out, *image, edge, surfaces, step)
    return filtered, spread


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
    space = np.empty((2, SPATIAL_BLOCK), np.float32)
    sums[:, 0] = 1
    sums[:, 1] = 0
    sums[:, 2, : last - first] = variance[:, row, first:last]
    for dy in range(max(-SPATIAL_RADIUS, -row), min(SPATIAL_RADIUS + 1, height - row)):
        for dx in range(-SPATIAL_RADIUS, SPATIAL_RADIUS + 1):
            left = max(first, -dx)
            right = min(last, width - dx)
            if (dx == 0 and dy == 0) or left >= right:
                continue
            weight = space[0, : right - left]
            exponent = space[1, : right - left]
            geometry_weights(weight, exponent, geometry, row, left, dx, dy)
            apply_exponents(weight, exponent)
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
    """See models.svgf.spatial_variance."""
    out = variance.clone(memory_format=torch.contiguous_format)
    for item in range(len(variance)):
        images = array(variance[item, :, 0]), array(mean[item, :, 0]), array(geometry[item, 0])
        spatial_variance_image(out[item, :, 0].numpy(), *images, where[item, 0].numpy())
    return out
