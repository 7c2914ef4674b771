"""Rows of pixels: loops along them that several kernels share, and walks over windows and over blocks of rows."""

from collections.abc import Iterator

import numpy as np

from datasets.channels import LUMINANCE_WEIGHTS
from models.compiled.arrays import RGB, Image, Index, Plane, Row, Rows, Scalar, f32
from models.compiled.jit import jit_in_any_order, jit_inlined

RED_WEIGHT, GREEN_WEIGHT, BLUE_WEIGHT = (np.float32(weight) for weight in LUMINANCE_WEIGHTS)
BLOCK_ROWS = 8  # rows that share one piece of scratch memory


@jit_in_any_order
def copy_line(line: Row, source: Row) -> None:
    for x in range(line.size):
        line[x] = source[x]


@jit_in_any_order
def add_line(line: Row, other: Row) -> None:
    for x in range(line.size):
        line[x] += other[x]


@jit_in_any_order
def scale_line(line: Row, factor: Row) -> None:
    for x in range(line.size):
        line[x] *= factor[x]


@jit_in_any_order
def divide_line(line: Row, sums: Row, weights: Row) -> None:
    for x in range(line.size):
        line[x] = sums[x] / weights[x]


@jit_in_any_order
def add_product(line: Row, weight: Row, values: Row) -> None:
    for x in range(line.size):
        line[x] += weight[x] * values[x]


@jit_in_any_order
def raise_line(line: Row, other: Row) -> None:
    for x in range(line.size):
        line[x] = other[x] if other[x] > line[x] else line[x]


@jit_in_any_order
def exclude(logits: Row, surface: Row, logit: Scalar) -> None:
    """A logit that has no weight for pixels that show no surface."""
    for x in range(logits.size):
        logits[x] = logits[x] if surface[x] > 0 else logit


@jit_in_any_order
def add_square(distance: Row, here: Row, there: Row) -> None:
    """distance += (here - there)²."""
    for x in range(distance.size):
        distance[x] += (here[x] - there[x]) * (here[x] - there[x])


@jit_in_any_order
def normalise(sums: Row, total: Row) -> None:
    """Weighted sums become means, 0 where no pixel has any weight."""
    for x in range(total.size):
        sums[x] = sums[x] / total[x] if total[x] > 0 else f32(0)


@jit_in_any_order
def scale_depth(line: Row, depth: Row, scale: Scalar) -> None:
    """Depth d as an input of networks: d / (d + scale), 1 for background."""
    for x in range(line.size):
        line[x] = depth[x] / (depth[x] + scale) if depth[x] > 0 else f32(1)


@jit_in_any_order
def transpose(out: Plane, plane: Plane) -> None:
    for j in range(plane.shape[1]):
        for i in range(plane.shape[0]):
            out[j, i] = plane[i, j]


@jit_inlined
def luminance(red: Scalar, green: Scalar, blue: Scalar) -> Scalar:
    return RED_WEIGHT * red + GREEN_WEIGHT * green + BLUE_WEIGHT * blue


@jit_inlined
def triple(image: Image, row: Index, left: Index, right: Index) -> RGB:
    """Pixels `left` to `right` - 1 of a row of an image (3, H, W); slices of a row alone are known to be contiguous."""
    return image[0, row, left:right], image[1, row, left:right], image[2, row, left:right]


@jit_inlined
def triple_of_lines(lines: Rows, left: Index, right: Index) -> RGB:
    return lines[0, left:right], lines[1, left:right], lines[2, left:right]


@jit_in_any_order
def columns_with_tap(row: Index, dx: Index, dy: Index, height: int, width: int) -> tuple[Index, Index]:
    """The columns, first and beyond the last, of a row whose tap at (dx, dy) is in the image."""
    outside = row + dy < 0 or row + dy >= height
    return (0, 0) if outside else (max(0, -dx), min(width, width - dx))


@jit_in_any_order
def window_taps(
    row: Index, radius: int, step: int, height: int, width: int
) -> Iterator[tuple[Index, Index, Index, Index]]:
    """Taps (dx, dy) of a window, `step` pixels apart, and the columns `left` to `right` - 1 of a row that have them.

    Those are the columns whose tap is in the image; taps that no pixel of the row has are left out.
    """
    for j in range(-radius, radius + 1):
        for i in range(-radius, radius + 1):
            left, right = columns_with_tap(row, i * step, j * step, height, width)
            if left < right:
                yield i * step, j * step, left, right


@jit_in_any_order
def block_count(height: int) -> int:
    return (height + BLOCK_ROWS - 1) // BLOCK_ROWS


@jit_in_any_order
def rows_of_block(block: Index, height: int) -> range:
    start = np.int64(block) * BLOCK_ROWS
    return range(start, min(start + BLOCK_ROWS, np.int64(height)))
