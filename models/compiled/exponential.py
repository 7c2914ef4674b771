"""exp in float32 as arithmetic that LLVM vectorises; a call to the mathematical library would keep loops scalar."""

from typing import Any

import numba
import numpy as np

LOG2E = np.float32(1.4426950408889634)
# 2^f on [-1/2, 1/2] by its Taylor series, coefficients ln(2)^i / i!
C1, C2, C3, C4, C5, C6 = (np.float32(np.log(2) ** i / f) for i, f in enumerate((1, 2, 6, 24, 120, 720), 1))


@numba.njit(cache=True, inline="always", fastmath={"contract"}, error_model="numpy")
def exp(x: Any) -> Any:
    """e^x for x in [-87, 88], within 4e-7 of relative error."""
    t = x * LOG2E
    n = np.floor(t + np.float32(0.5))
    f = t - n
    p = C5 + f * C6
    p = C4 + f * p
    p = C3 + f * p
    p = C2 + f * p
    p = C1 + f * p
    p = np.float32(1) + f * p
    return p * np.int32((np.int32(n) + np.int32(127)) << np.int32(23)).view(np.float32)


MANTISSA, ONE = np.int32(0x7FFFFF), np.int32(0x3F800000)
L3, L5, L7, L9 = (np.float32(1 / n) for n in (3, 5, 7, 9))


@numba.njit(cache=True, inline="always", fastmath={"contract"}, error_model="numpy")
def log(x: Any) -> Any:
    """ln x for normal positive x: exponent and mantissa apart, and the series of 2 artanh((m - 1) / (m + 1))."""
    bits = np.float32(x).view(np.int32)
    m = np.int32((bits & MANTISSA) | ONE).view(np.float32)
    e = np.float32((bits >> np.int32(23)) - np.int32(127))
    large = m > np.float32(1.4142135)
    m = m * np.float32(0.5) if large else m
    e = e + np.float32(1) if large else e
    t = (m - np.float32(1)) / (m + np.float32(1))
    s = t * t
    series = np.float32(1) + s * (L3 + s * (L5 + s * (L7 + s * L9)))
    return e / LOG2E + np.float32(2) * t * series
