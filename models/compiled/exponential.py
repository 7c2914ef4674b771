"""exp and ln in float32 as arithmetic that LLVM vectorises, unlike calls to the mathematical library."""

import numpy as np

from models.compiled.arrays import Scalar
from models.compiled.jit import jit_inlined

MIN_EXPONENT = -80.0  # exp of less is denormal in float32, which is slow; what it leaves is 1e-35
LOG2E = np.float32(1.4426950408889634)
# 2^f on [-1/2, 1/2] as 1 + f * a polynomial, the minimax one: its relative error is at most 9.2e-8
EXP_1, EXP_2, EXP_3, EXP_4, EXP_5 = (
    np.float32(coefficient) for coefficient in (0.69314698, 0.24022242, 0.05550734, 0.00967151, 0.00132647)
)
MANTISSA_WIDTH = np.int32(23)


@jit_inlined
def exp(x: Scalar) -> Scalar:
    """e^x for x in [-87, 88], within 3e-7 of relative error; exactly 1 for 0."""
    t = x * LOG2E
    n = np.rint(t)
    f = t - n
    p = EXP_4 + f * EXP_5
    p = EXP_3 + f * p
    p = EXP_2 + f * p
    p = EXP_1 + f * p
    p = np.float32(1) + f * p
    return np.int32(np.float32(p).view(np.int32) + (np.int32(n) << MANTISSA_WIDTH)).view(np.float32)  # p * 2^n


MANTISSA_BITS = np.int32(0x7FFFFF)
BITS_OF_ONE = np.int32(0x3F800000)
# The series of 2 artanh: 1, 1/3, 1/5, ...
LOG_3, LOG_5, LOG_7, LOG_9 = (np.float32(1 / n) for n in (3, 5, 7, 9))


@jit_inlined
def log(x: Scalar) -> Scalar:
    """ln x for normal positive x = m 2^e, as e ln 2 and the series of 2 artanh((m - 1) / (m + 1))."""
    bits = np.float32(x).view(np.int32)
    m = np.int32((bits & MANTISSA_BITS) | BITS_OF_ONE).view(np.float32)
    e = np.float32((bits >> MANTISSA_WIDTH) - np.int32(127))
    large = m > np.float32(1.4142135)
    m = m * np.float32(0.5) if large else m
    e = e + np.float32(1) if large else e
    t = (m - np.float32(1)) / (m + np.float32(1))
    s = t * t
    series = np.float32(1) + s * (LOG_3 + s * (LOG_5 + s * (LOG_7 + s * LOG_9)))
    return e / LOG2E + np.float32(2) * t * series
