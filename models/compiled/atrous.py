"""What the compiled à-trous filters share."""

from typing import Any

import numpy as np

from models.atrous import B3_SPLINE
from models.compiled.exponential import exp
from models.compiled.jit import jit_in_any_order

SPLINE = np.array(B3_SPLINE, np.float32)
NEGLIGIBLE = np.float32(30)  # e^-30 = 1e-13 counts as 0: denormal numbers are slow


@jit_in_any_order
def decay(a: Any) -> Any:
    """e^-a for a >= 0."""
    return exp(-min(a, NEGLIGIBLE)) if a < NEGLIGIBLE else np.float32(0)


@jit_in_any_order
def columns_with_tap(row: Any, dx: int, dy: int, height: int, width: int) -> Any:
    """The columns, first and beyond the last, of a row whose tap at (dx, dy) is another pixel of the image."""
    outside = (dx == 0 and dy == 0) or row + dy < 0 or row + dy >= height
    return (0, 0) if outside else (max(0, -dx), min(width, width - dx))
