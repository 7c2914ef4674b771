"""What several kernels do with lines of pixels."""

from typing import Any

import numpy as np

from models.compiled.jit import jit_in_any_order

ONE = np.float32(1)


@jit_in_any_order
def copy_line(line: Any, source: Any) -> None:
    for x in range(line.size):
        line[x] = source[x]


@jit_in_any_order
def fill_line(line: Any, value: Any) -> None:
    for x in range(line.size):
        line[x] = value


@jit_in_any_order
def add_line(line: Any, other: Any) -> None:
    for x in range(line.size):
        line[x] += other[x]


@jit_in_any_order
def scale_line(line: Any, factor: Any) -> None:
    for x in range(line.size):
        line[x] *= factor[x]


@jit_in_any_order
def add_product(line: Any, one: Any, other: Any) -> None:
    for x in range(line.size):
        line[x] += one[x] * other[x]


@jit_in_any_order
def scale_depth(line: Any, depth: Any, scale: Any) -> None:
    """What networks see of depth: d / (d + scale), 1 for background."""
    for x in range(line.size):
        line[x] = depth[x] / (depth[x] + scale) if depth[x] > 0 else ONE


@jit_in_any_order
def interleave(out: Any, lines: Any) -> None:
    """out (n, C) = lines (C, n), transposed."""
    for x in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[x, c] = lines[c, x]
