"""models.networks.nbgd.grid_mean for the CPU: two rows of cells at a time, which stay in the cache.

A row of cells is a line of columns * levels * 4 numbers: red, green, blue and weight. It has an empty column and level
more at either end, so that no pixel has to test whether its cells are inside.
"""

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.arrays import RGB, Image, Index, Plane, Row, Scalar, f32
from models.compiled.jit import jit_in_order, jit_inlined, jit_parallel, jit_with_memory, run_items
from models.compiled.lines import triple

GUIDES = 256  # values of a guide (Meng et al. 2020), which cells of a grid divide as they divide pixels
GRID_STRIP_ROWS = 64  # of pixels that a thread filters at once; a multiple of all spacings


@jit_inlined
def in_cells(position: Scalar, per_cell: Scalar) -> Scalar:
    """Where a pixel, or a guide, lies along an axis, counted from the middle of the cell before the grid."""
    return (position + f32(0.5)) * per_cell + f32(0.5)


@jit_inlined
def cells_of_pixel(x: Index, guide: Scalar, levels: int, per_cell: Scalar) -> tuple[Index, Scalar, Scalar]:
    """Where the first of the four cells nearest to a pixel begins, and how far across and behind it the pixel is."""
    inside = guide if f32(0) <= guide <= f32(1) else f32(0)  # NaN would be outside of memory
    across = in_cells(f32(x), per_cell)
    deep = in_cells(f32(GUIDES - 1) * inside, per_cell)
    column = np.int64(across)
    level = np.int64(deep)
    return (column * levels + level) * 4, across - f32(column), deep - f32(level)


@jit_inlined
def weight_of(tap: int, right: Scalar, behind: Scalar) -> Scalar:
    """Bilinear weight of one of the four cells."""
    return (right if tap // 2 else f32(1) - right) * (behind if tap % 2 else f32(1) - behind)


@jit_in_order
def splat_line(
    cells: Row, by_row: Scalar, colour: RGB, guide: Row, surface: Row, levels: int, per_cell: Scalar
) -> None:
    """Add a line of pixels, weighted by_row, to a row of cells."""
    red, green, blue = colour
    for x in range(guide.size):
        if surface[x] == f32(0):
            continue
        first, right, behind = cells_of_pixel(x, guide[x], levels, per_cell)
        for tap in range(4):
            weight = by_row * weight_of(tap, right, behind)
            cell = first + (tap // 2 * levels + tap % 2) * 4
            cells[cell] += weight * red[x]
            cells[cell + 1] += weight * green[x]
            cells[cell + 2] += weight * blue[x]
            cells[cell + 3] += weight


@jit_in_order
def normalise_cells(cells: Row, levels: int) -> None:
    """Sums become means, and weights 1, of the cells that have any and are inside; all others become 0."""
    columns = cells.size // (4 * levels)
    for column in range(columns):
        for level in range(levels):
            cell = (column * levels + level) * 4
            inside = 0 < column < columns - 1 and 0 < level < levels - 1
            scale = f32(1) / cells[cell + 3] if inside and cells[cell + 3] > f32(0) else f32(0)
            cells[cell] *= scale
            cells[cell + 1] *= scale
            cells[cell + 2] *= scale
            cells[cell + 3] = f32(1) if scale > f32(0) else f32(0)


@jit_in_order
def slice_line(
    colour: RGB, above: Row, below: Row, down: Scalar, guide: Row, surface: Row, levels: int, per_cell: Scalar
) -> None:
    """Fill a line of pixels, `down` of the way from the middle of the row of cells above to that of the one below."""
    red, green, blue = colour
    for x in range(guide.size):
        if surface[x] == f32(0):
            red[x] = green[x] = blue[x] = f32(0)
            continue
        first, right, behind = cells_of_pixel(x, guide[x], levels, per_cell)
        r = g = b = total = f32(0)
        for tap in range(4):
            weight = weight_of(tap, right, behind)
            lower = weight * down
            upper = weight - lower
            cell = first + (tap // 2 * levels + tap % 2) * 4
            r += upper * above[cell] + lower * below[cell]
            g += upper * above[cell + 1] + lower * below[cell + 1]
            b += upper * above[cell + 2] + lower * below[cell + 2]
            total += upper * above[cell + 3] + lower * below[cell + 3]
        scale = f32(1) / total
        red[x] = r * scale
        green[x] = g * scale
        blue[x] = b * scale


@jit_with_memory
def fill_cells(cells: Row, row: Index, image: Image, guide: Plane, surface: Plane, levels: int, spacing: int) -> None:
    """The means of a row of cells; 0 in a row outside the grid."""
    height, width = guide.shape
    per_cell = f32(1) / f32(spacing)
    cells[:] = f32(0)
    if not 0 <= row * spacing < height:
        return
    first = row * spacing - spacing // 2
    for y in range(max(first, 0), min(first + 2 * spacing, height)):
        by_row = f32(1) - abs(in_cells(f32(y), per_cell) - f32(row + 1))
        splat_line(cells, by_row, triple(image, y, 0, width), guide[y], surface[y], levels, per_cell)
    normalise_cells(cells, levels)


@jit_parallel
def filter_image(out: Image, image: Image, guide: Plane, surface: Plane, spacing: int) -> None:
    height, width = guide.shape
    levels = GUIDES // spacing + 2
    columns = (width + spacing - 1) // spacing + 2
    per_cell = f32(1) / f32(spacing)
    strips = (height + spacing // 2 + GRID_STRIP_ROWS - 1) // GRID_STRIP_ROWS
    for strip in numba.prange(strips):
        above = np.empty(columns * levels * 4, np.float32)
        below = np.empty(columns * levels * 4, np.float32)
        # Pixels from the middle of a row of cells to the middle of the next one read the same two rows.
        first = np.int64(strip) * GRID_STRIP_ROWS // spacing
        fill_cells(below, first - 1, image, guide, surface, levels, spacing)
        for row in range(first, first + GRID_STRIP_ROWS // spacing):
            above, below = below, above
            fill_cells(below, row, image, guide, surface, levels, spacing)
            top = row * spacing - spacing // 2
            for y in range(max(top, 0), min(top + spacing, height)):
                down = in_cells(f32(y), per_cell) - f32(row)
                slice_line(triple(out, y, 0, width), above, below, down, guide[y], surface[y], levels, per_cell)


def grid_mean(image: Tensor, guide: Tensor, spacing: int, surface: Tensor | None = None) -> Tensor:
    out = torch.empty_like(image, memory_format=torch.contiguous_format)
    surface = torch.ones_like(guide) if surface is None else surface
    run_items(filter_image, [out], [image, guide[:, 0], surface[:, 0]], spacing)
    return out
