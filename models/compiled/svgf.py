"""models.svgf for the processor: every row by itself, every loop along it vectorised."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from datasets.channels import LUMINANCE_WEIGHTS
from models.atrous import B3_SPLINE
from models.compiled import array, jit, jit_parallel, threads
from models.compiled.exponential import exp

RED, GREEN, BLUE = (np.float32(weight) for weight in LUMINANCE_WEIGHTS)
SPLINE = np.array(B3_SPLINE, np.float32)
NEGLIGIBLE = np.float32(30)  # e^-30 = 1e-13 counts as 0: denormal numbers are slow
LEAST_COSINE = np.float32(0.79)  # to the 128th it is 8e-14
LEAST_WEIGHT = np.float32(1e-15)
BLOCK = 64  # px; the spatial estimate is made for all of a block where one needs it


@jit
def decay(a: Any) -> Any:
    """e^-a for a >= 0."""
    return exp(-min(a, NEGLIGIBLE)) if a < NEGLIGIBLE else np.float32(0)


@jit
def reach(row: Any, dx: int, dy: int, height: int, width: int) -> Any:
    """The columns, first and beyond the last, of a row whose tap at (dx, dy) is another pixel of the image."""
    outside = (dx == 0 and dy == 0) or row + dy < 0 or row + dy >= height
    return (0, 0) if outside else (max(0, -dx), min(width, width - dx))


@jit
def smaller(a: Any, b: Any) -> Any:
    """Which of two is nearer to 0; 0 where both are infinite."""
    nearer = a if abs(a) < abs(b) else b
    return nearer if abs(nearer) < np.inf else np.float32(0)


@jit
def steps(step: Any, depth: Any, to_depth: Any, mesh: Any, to_mesh: Any) -> None:
    """step (n): change of depth to the neighbours, infinite where they are on another mesh."""
    for i in range(step.size):
        step[i] = to_depth[i] - depth[i] if mesh[i] == to_mesh[i] else np.float32(np.inf)


@jit
def geometry_row(
    packed: Any, row: Any, depth: Any, normal: Any, mesh: Any, sigma: Any, epsilon: Any, smallest: Any
) -> None:
    """A row of packed (7, H, W) from depth (H, W), normal (3, H, W), mesh (H, W)."""
    height, width = depth.shape
    z, here = depth[row], mesh[row]
    ahead, behind = np.full(width, np.float32(np.inf)), np.full(width, np.float32(np.inf))
    across = np.full(width + 1, np.float32(np.inf))
    if row + 1 < height:
        steps(ahead, z, depth[row + 1], here, mesh[row + 1])
    if row > 0:
        steps(behind, depth[row - 1], z, mesh[row - 1], here)
    steps(across[1:width], z[:-1], z[1:], here[:-1], here[1:])
    x, y, n_z = normal[0, row], normal[1, row], normal[2, row]
    out_x, out_y, out_z, out_depth = packed[0, row], packed[1, row], packed[2, row], packed[3, row]
    along_x, along_y, tolerance = packed[4, row], packed[5, row], packed[6, row]
    for i in range(width):
        length = np.sqrt(x[i] * x[i] + y[i] * y[i] + n_z[i] * n_z[i])
        normalise = np.float32(1) / max(length, smallest) if z[i] > 0 else np.float32(0)
        out_x[i], out_y[i], out_z[i], out_depth[i] = x[i] * normalise, y[i] * normalise, n_z[i] * normalise, z[i]
        along_x[i] = sigma * smaller(across[i + 1], across[i])
        along_y[i] = sigma * smaller(ahead[i], behind[i])
        tolerance[i] = epsilon * abs(z[i]) + smallest


@jit_parallel
def geometry_image(packed: Any, depth: Any, normal: Any, mesh: Any, sigma: Any, epsilon: Any, smallest: Any) -> None:
    for row in numba.prange(depth.shape[0]):
        geometry_row(packed, np.int64(row), depth, normal, mesh, sigma, epsilon, smallest)


def pack_geometry(
    depth: Tensor, normal: Tensor, mesh_id: Tensor, sigma: float, epsilon: float, smallest: float
) -> Tensor:
    """See models.svgf.pack_geometry."""
    threads()
    packed = depth.new_empty(len(depth), 1, 7, *depth.shape[-2:])
    numbers = np.float32(sigma), np.float32(epsilon), np.float32(smallest)
    for item in range(len(depth)):
        images = array(depth[item, 0]), array(normal[item]), array(mesh_id[item, 0])
        geometry_image(packed[item, 0].numpy(), *images, *numbers)
    return packed


@jit
def geometry_weights(weight: Any, geometry: Any, row: int, left: int, dx: int, dy: int) -> None:
    """models.svgf.geometry_weight of the n pixels from `left` on in a row of the geometry (7, H, W): weight (n)."""
    to, right, ahead, behind = row + dy, left + weight.size, left + dx, left + dx + weight.size
    # One name per line of memory: Numba knows these as contiguous, unlike lines of a slice in two dimensions.
    x, y, z = geometry[0, row, left:right], geometry[1, row, left:right], geometry[2, row, left:right]
    to_x, to_y, to_z = geometry[0, to, ahead:behind], geometry[1, to, ahead:behind], geometry[2, to, ahead:behind]
    depth, to_depth = geometry[3, row, left:right], geometry[3, to, ahead:behind]
    along_x, along_y, epsilon = geometry[4, row, left:right], geometry[5, row, left:right], geometry[6, row, left:right]
    by_x, by_y = np.float32(dx), np.float32(dy)
    for i in range(weight.size):
        w_n = x[i] * to_x[i] + y[i] * to_y[i] + z[i] * to_z[i]
        w_n = w_n if w_n > LEAST_COSINE else np.float32(0)
        for _ in range(7):
            w_n *= w_n
        expected = abs(along_x[i] * by_x + along_y[i] * by_y) + epsilon[i]
        w_n *= decay(abs(depth[i] - to_depth[i]) / expected)
        weight[i] = w_n if w_n > LEAST_WEIGHT else np.float32(0)


@jit
def add_tap(
    sums: Any, h: Any, weight: Any, colour: Any, variance: Any, edge: Any, row: int, left: int, dx: int, dy: int
) -> None:
    """Add one tap of the n pixels from `left` on in a row to sums (5, W): of weights, of colours, of variances.

    weight (n) is geometrical; colour (3, H, W), variance (H, W), edge (2, H, W): luminance and its scale.
    """
    to, right, ahead, behind = row + dy, left + weight.size, left + dx, left + dx + weight.size
    total, spread, v = sums[0, left:right], sums[4, left:right], variance[to, ahead:behind]
    red, green, blue = sums[1, left:right], sums[2, left:right], sums[3, left:right]
    r, g, b = colour[0, to, ahead:behind], colour[1, to, ahead:behind], colour[2, to, ahead:behind]
    y, scale, to_y = edge[0, row, left:right], edge[1, row, left:right], edge[0, to, ahead:behind]
    for i in range(weight.size):
        w = h * weight[i] * decay(abs(y[i] - to_y[i]) * scale[i])
        w = w if w > LEAST_WEIGHT else np.float32(0)
        total[i] += w
        red[i] += w * r[i]
        green[i] += w * g[i]
        blue[i] += w * b[i]
        spread[i] += w * w * v[i]


@jit
def filter_row(sums: Any, row: Any, step: int, colour: Any, variance: Any, edge: Any, geometry: Any) -> None:
    """sums (S, 5, W) over the taps of one row of colour (S, 3, H, W), variance (S, H, W), edge (S, 2, H, W)."""
    signals, _, height, width = colour.shape
    space = np.empty(width, np.float32)
    h = SPLINE[2] * SPLINE[2]
    for s in range(signals):
        sums[s, 0] = h
        sums[s, 1:4] = h * colour[s, :, row]
        sums[s, 4] = h * h * variance[s, row]
    for j in range(-2, 3):
        for i in range(-2, 3):
            dx, dy = i * step, j * step
            left, right = reach(row, dx, dy, height, width)
            if left >= right:
                continue
            weight = space[: right - left]
            geometry_weights(weight, geometry, row, left, dx, dy)
            for s in range(signals):
                add_tap(
                    sums[s], SPLINE[j + 2] * SPLINE[i + 2], weight, colour[s], variance[s], edge[s], row, left, dx, dy
                )


@jit
def finish_row(colour: Any, variance: Any, row: int, sums: Any) -> None:
    """A row of colour (3, H, W) and of variance (H, W) from sums (5, W)."""
    r, g, b, v = colour[0, row], colour[1, row], colour[2, row], variance[row]
    total, red, green, blue, spread = sums[0], sums[1], sums[2], sums[3], sums[4]
    for i in range(total.size):
        normalise = np.float32(1) / total[i]
        r[i] = red[i] * normalise
        g[i] = green[i] * normalise
        b[i] = blue[i] * normalise
        v[i] = spread[i] * normalise * normalise


@jit_parallel
def filter_image(
    colour_out: Any, variance_out: Any, colour: Any, variance: Any, edge: Any, geometry: Any, step: int
) -> None:
    signals, _, height, width = colour.shape
    for row in numba.prange(height):
        sums = np.empty((signals, 5, width), np.float32)
        filter_row(sums, np.int64(row), step, colour, variance, edge, geometry)
        for s in range(signals):
            finish_row(colour_out[s], variance_out[s], row, sums[s])


@jit
def edge_row(edge: Any, colour: Any, variance: Any, row: Any, sigma: Any, epsilon: Any) -> None:
    """A row of edge (2, H, W): luminance of colour (3, H, W), and models.svgf.edge_scale of variance (H, W)."""
    height, width = variance.shape
    quarter, half = np.float32(0.25), np.float32(0.5)
    columns, inside = np.zeros(width + 2, np.float32), np.zeros(width + 2, np.float32)
    total, weight = columns[1:-1], inside[1:-1]
    for y in range(max(row - 1, 0), min(row + 2, height)):
        h, line = half if y == row else quarter, variance[y]
        for x in range(width):
            total[x] += h * line[x]
            weight[x] += h
    r, g, b = colour[0, row], colour[1, row], colour[2, row]
    luminance, scale = edge[0, row], edge[1, row]
    for x in range(width):
        luminance[x] = RED * r[x] + GREEN * g[x] + BLUE * b[x]
        mean = quarter * columns[x] + half * columns[x + 1] + quarter * columns[x + 2]
        mean /= quarter * inside[x] + half * inside[x + 1] + quarter * inside[x + 2]
        scale[x] = np.float32(1) / (sigma * np.sqrt(mean + epsilon))


@jit_parallel
def edge_image(edge: Any, colour: Any, variance: Any, sigma: Any, epsilon: Any) -> None:
    signals, height, _ = variance.shape
    for row in numba.prange(height):
        for s in range(signals):
            edge_row(edge[s], colour[s], variance[s], np.int64(row), sigma, epsilon)


def filter_level(
    colour: Tensor, variance: Tensor, geometry: Tensor, step: int, sigma: float, epsilon: float
) -> tuple[Tensor, Tensor]:
    """See models.svgf.filter_level; `sigma` and `epsilon` are those of Eq. 5."""
    threads()
    colour, variance = colour.contiguous(), variance.contiguous()
    filtered, spread = torch.empty_like(colour), torch.empty_like(variance)
    edge = np.empty((colour.shape[1], 2, *colour.shape[-2:]), np.float32)
    for item in range(len(colour)):
        image = colour[item].numpy(), variance[item, :, 0].numpy()
        edge_image(edge, *image, np.float32(sigma), np.float32(epsilon))
        filter_image(filtered[item].numpy(), spread[item, :, 0].numpy(), *image, edge, array(geometry[item, 0]), step)
    return filtered, spread


@jit
def add_spatial_tap(
    sums: Any, first: int, weight: Any, variance: Any, mean: Any, row: int, left: int, dx: int, dy: int
) -> None:
    """Add one tap of the n pixels from `left` on to sums (3, BLOCK), which begin with the pixel at `first`.

    Of weights, of means less the centre's, of their squares plus variances.
    """
    to, right, ahead, behind = row + dy, left + weight.size, left + dx, left + dx + weight.size
    start, stop = left - first, right - first
    total, means, squares = sums[0, start:stop], sums[1, start:stop], sums[2, start:stop]
    centre, there, v = mean[row, left:right], mean[to, ahead:behind], variance[to, ahead:behind]
    for i in range(weight.size):
        off = there[i] - centre[i]
        total[i] += weight[i]
        means[i] += weight[i] * off
        squares[i] += weight[i] * (off * off + v[i])


@jit
def spatial_block(
    sums: Any, row: int, first: int, last: int, variance: Any, mean: Any, geometry: Any, radius: int
) -> None:
    """sums (S, 3, BLOCK) over the windows of the pixels `first` to `last` - 1 of a row of variance, mean (S, H, W)."""
    signals, height, width = variance.shape
    space = np.empty(BLOCK, np.float32)
    sums[:, 0], sums[:, 1] = 1, 0
    sums[:, 2, : last - first] = variance[:, row, first:last]
    for dy in range(max(-radius, -row), min(radius + 1, height - row)):
        for dx in range(-radius, radius + 1):
            left, right = max(first, -dx), min(last, width - dx)
            if (dx == 0 and dy == 0) or left >= right:
                continue
            weight = space[: right - left]
            geometry_weights(weight, geometry, row, left, dx, dy)
            for s in range(signals):
                add_spatial_tap(sums[s], first, weight, variance[s], mean[s], row, left, dx, dy)


@jit
def spatial_row(out: Any, row: Any, variance: Any, mean: Any, geometry: Any, where: Any, radius: int) -> None:
    """A row of out (S, H, W) `where` (H, W) it is wanted."""
    signals, _, width = variance.shape
    sums = np.empty((signals, 3, BLOCK), np.float32)
    for first in range(0, width, BLOCK):
        last = min(first + BLOCK, width)
        if not where[row, first:last].any():
            continue
        spatial_block(sums, row, first, last, variance, mean, geometry, radius)
        for s in range(signals):
            for x in range(first, last):
                if where[row, x]:
                    total, means, squares = sums[s, 0, x - first], sums[s, 1, x - first], sums[s, 2, x - first]
                    out[s, row, x] = max(squares / total - (means / total) ** 2, np.float32(0))


@jit_parallel
def spatial_image(out: Any, variance: Any, mean: Any, geometry: Any, where: Any, radius: int) -> None:
    for row in numba.prange(variance.shape[1]):
        spatial_row(out, np.int64(row), variance, mean, geometry, where, radius)


def spatial_variance(variance: Tensor, mean: Tensor, geometry: Tensor, where: Tensor, radius: int) -> Tensor:
    """See models.svgf.spatial_variance."""
    threads()
    out = variance.clone(memory_format=torch.contiguous_format)
    for item in range(len(variance)):
        images = array(variance[item, :, 0]), array(mean[item, :, 0]), array(geometry[item, 0])
        spatial_image(out[item, :, 0].numpy(), *images, where[item, 0].numpy(), radius)
    return out
