"""models.networks.bilateral_grid for the processor: two rows of cells at a time, which stay in the cache."""

from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor

from models.compiled.jit import array, jit_in_order, jit_inlined, jit_parallel, jit_with_memory, plane_or_empty
from models.compiled.lines import fill_line

GUIDES = 256  # values of a guide (Meng et al. 2020), which cells of a grid divide as they divide pixels
HALF = np.float32(0.5)
ONE = np.float32(1)
ZERO = np.float32(0)
GRID_STRIP_ROWS = 64  # of pixels that a thread filters at once; a multiple of all spacings

# A row of cells is a line of columns * levels * 4 numbers: red, green, blue and weight. It has a column and a level
# more at either end, which are emptied before they are read: so no pixel has to ask whether its cells are inside.


@jit_inlined
def in_cells(position: Any, per_cell: Any) -> Any:
    """Where a pixel, or a guide, lies along an axis, counted from the middle of the cell before the grid."""
    return (position + HALF) * per_cell + HALF


@jit_inlined
def cells_around(x: Any, guide: Any, levels: Any, per_cell: Any) -> Any:
    """Where the first cell around a pixel of a line begins, and how far it lies to the right of it and behind it."""
    inside = guide if ZERO <= guide <= ONE else ZERO  # NaN would be outside of memory
    across = in_cells(np.float32(x), per_cell)
    deep = in_cells(np.float32(GUIDES - 1) * inside, per_cell)
    column = np.int64(across)
    level = np.int64(deep)
    return (column * levels + level) * 4, across - np.float32(column), deep - np.float32(level)


@jit_inlined
def weight_of(tap: Any, right: Any, behind: Any) -> Any:
    """Of the four cells in a row that are around a pixel."""
    return (right if tap // 2 else ONE - right) * (behind if tap % 2 else ONE - behind)


@jit_in_order
def splat_line(
    cells: Any, by_row: Any, red: Any, green: Any, blue: Any, guide: Any, surface: Any, levels: Any, per_cell: Any
) -> None:
    """Add a line of pixels, weighted by_row, to a row of cells."""
    for x in range(guide.size):
        if surface.size > 0 and surface[x] == ZERO:
            continue
        first, right, behind = cells_around(x, guide[x], levels, per_cell)
        for tap in range(4):
            weight = by_row * weight_of(tap, right, behind)
            cell = first + (tap // 2 * levels + tap % 2) * 4
            cells[cell] += weight * red[x]
            cells[cell + 1] += weight * green[x]
            cells[cell + 2] += weight * blue[x]
            cells[cell + 3] += weight


@jit_in_order
def normalise(cells: Any, levels: Any) -> None:
    """Sums become means, and weights 1, of the cells that have any and are inside; all others become 0."""
    columns = cells.size // (4 * levels)
    for column in range(columns):
        for level in range(levels):
            cell = (column * levels + level) * 4
            inside = 0 < column < columns - 1 and 0 < level < levels - 1
            scale = ONE / cells[cell + 3] if inside and cells[cell + 3] > ZERO else ZERO
            cells[cell] *= scale
            cells[cell + 1] *= scale
            cells[cell + 2] *= scale
            cells[cell + 3] = ONE if scale > ZERO else ZERO


@jit_in_order
def slice_line(
    red: Any,
    green: Any,
    blue: Any,
    above: Any,
    below: Any,
    down: Any,
    guide: Any,
    surface: Any,
    levels: Any,
    per_cell: Any,
) -> None:
    """Fill a line of pixels, `down` of the way from the middle of the row of cells above to that of the one below."""
    for x in range(guide.size):
        if surface.size > 0 and surface[x] == ZERO:
            red[x] = green[x] = blue[x] = ZERO
            continue
        first, right, behind = cells_around(x, guide[x], levels, per_cell)
        r = g = b = total = ZERO
        for tap in range(4):
            weight = weight_of(tap, right, behind)
            lower = weight * down
            upper = weight - lower
            cell = first + (tap // 2 * levels + tap % 2) * 4
            r += upper * above[cell] + lower * below[cell]
            g += upper * above[cell + 1] + lower * below[cell + 1]
            b += upper * above[cell + 2] + lower * below[cell + 2]
            total += upper * above[cell + 3] + lower * below[cell + 3]
        scale = ONE / total
        red[x] = r * scale
        green[x] = g * scale
        blue[x] = b * scale


@jit_with_memory
def line(surface: Any, y: Any) -> Any:
    return surface[min(y, surface.shape[0] - 1)] if surface.size > 0 else surface.ravel()


@jit_with_memory
def fill_cells(cells: Any, row: Any, image: Any, guide: Any, surface: Any, levels: Any, spacing: Any) -> None:
    """The means of a row of cells; 0 in a row outside the grid."""
    height = guide.shape[0]
    per_cell = ONE / np.float32(spacing)
    fill_line(cells, ZERO)
    if not 0 <= row * spacing < height:
        return
    first = row * spacing - spacing // 2
    for y in range(max(first, 0), min(first + 2 * spacing, height)):
        by_row = ONE - abs(in_cells(np.float32(y), per_cell) - np.float32(row + 1))
        lines = image[0, y], image[1, y], image[2, y], guide[y], line(surface, y)
        splat_line(cells, by_row, *lines, levels, per_cell)
    normalise(cells, levels)


@jit_parallel
def filter_image(out: Any, image: Any, guide: Any, surface: Any, spacing: int) -> None:
    """out and image (3, H, W), guide (H, W), surface (H, W) or empty, see models.networks.bilateral_grid.grid_mean."""
    height, width = guide.shape
    levels = GUIDES // spacing + 2
    columns = (width + spacing - 1) // spacing + 2
    per_cell = ONE / np.float32(spacing)
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
                down = in_cells(np.float32(y), per_cell) - np.float32(row)
                lines = guide[y], line(surface, y)
                slice_line(out[0, y], out[1, y], out[2, y], above, below, down, *lines, levels, per_cell)


def grid_mean(image: Tensor, guide: Tensor, spacing: int, surface: Tensor | None = None) -> Tensor:
    """See models.networks.bilateral_grid.grid_mean."""
    out = torch.empty_like(image, memory_format=torch.contiguous_format)
    for item in range(len(image)):
        planes = array(image[item]), array(guide[item, 0]), plane_or_empty(surface, item)
        filter_image(out[item].numpy(), *planes, spacing)
    return out
