"""Random numbers as a pure function of (pixel, seed, sample index, dimension): no state, no layout to get wrong.

Every pair of dimensions is a (0, 2)-sequence of its own: the first two Sobol dimensions, Owen-scrambled by hashing and
visited in an Owen-shuffled order (Burley 2020, "Practical Hash-based Owen Scrambling", JCGT 9(4), §3). One sample alone
is uniform and independent of every other seed's; many samples of one seed stratify.
"""

from typing import Any

import numpy as np

from render.backend import dr, mi

ONE_MINUS_EPSILON = float(np.nextafter(np.float32(1), np.float32(0)))


def hash32(x: Any) -> Any:
    """The output permutation of PCG (O'Neill 2014, RXS M XS 32), a good integer hash."""
    x = x * 747796405 + 2891336453
    x = ((x >> ((x >> 28) + 4)) ^ x) * 277803737
    return (x >> 22) ^ x


def scramble_reversed(x: Any, seed: Any) -> Any:
    """Owen scrambling of an integer whose bits are reversed: every bit is flipped by a hash of the lower ones.

    The Laine-Karras permutation with the constants that Vegdahl (2021) found by search.
    """
    x = x ^ (x * 0x3D20ADEA)
    x = x + seed
    x = x * ((seed >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    return x ^ (x * 0x53A22864)


def sobol_second_reversed(index: Any) -> Any:
    """The second Sobol dimension, bits reversed: index times the Pascal triangle mod 2, one Kronecker factor a line."""
    index = index ^ ((index & 0xAAAAAAAA) >> 1)
    index = index ^ ((index & 0xCCCCCCCC) >> 2)
    index = index ^ ((index & 0xF0F0F0F0) >> 4)
    index = index ^ ((index & 0xFF00FF00) >> 8)
    return index ^ (index >> 16)


def to_unit(x: Any) -> Any:
    """Integers to floats in [0, 1)."""
    return mi.Float(x >> 8) * 2**-24


class Sampler:
    """Sample `index` (mi.UInt32) of the sequences that `key` (a hash of pixel and seed) and the path's `depth` name."""

    def __init__(self, key: Any, index: Any, depth: Any):
        self.key, self.reversed_index, self.dimension = hash32(key ^ depth), dr.brev(index), 0

    def _next(self) -> tuple[Any, Any]:
        self.dimension += 1
        seed = hash32(self.key ^ mi.UInt32(self.dimension * 0x9E3779B9 & 0xFFFFFFFF))
        return dr.brev(scramble_reversed(self.reversed_index, seed)), seed

    def next_1d(self) -> Any:
        """mi.Float in [0, 1)."""
        index, seed = self._next()
        return to_unit(dr.brev(scramble_reversed(index, hash32(seed + 1))))

    def next_2d(self) -> Any:
        """mi.Point2f in [0, 1)^2."""
        index, seed = self._next()
        x = dr.brev(scramble_reversed(index, hash32(seed + 1)))
        y = dr.brev(scramble_reversed(sobol_second_reversed(index), hash32(seed + 2)))
        return mi.Point2f(to_unit(x), to_unit(y))


CYCLE = 16  # frames
PRIMES = (  # six numbers a bounce, four bounces
    *((2, 3, 5, 7, 11, 13), (17, 19, 23, 29, 31, 37)),
    *((41, 43, 47, 53, 59, 61), (67, 71, 73, 79, 83, 89)),
)


class Halton:
    """Point `index` mod 16 of the Halton sequence, shifted in every pixel by its own random vector (mod 1).

    Real-time renderers draw one point of the cycle a frame (SVGF §3, RAE §3.1): each frame alone is unbiased, and the
    mean of 16 consecutive ones is less noisy than that of independent ones. `key` fixes the shift, so the frames of a
    realisation share it. Bounces beyond the fourth repeat the primes of the first with other shifts.
    """

    def __init__(self, key: Any, index: Any, depth: Any):
        self.key, self.index, self.dimension = hash32(key ^ depth), index & (CYCLE - 1), 0
        self.bounce = (depth - 1) & (len(PRIMES) - 1)

    def next_1d(self) -> Any:
        """mi.Float in [0, 1)."""
        base = mi.UInt32(PRIMES[0][self.dimension])
        for bounce in range(1, len(PRIMES)):
            base = dr.select(self.bounce == bounce, PRIMES[bounce][self.dimension], base)
        shift = to_unit(hash32(self.key ^ mi.UInt32(self.dimension * 0x9E3779B9 & 0xFFFFFFFF)))
        self.dimension += 1
        remaining, scale, inverse = self.index, dr.rcp(mi.Float(base)), mi.Float(0)
        weight = scale
        for _ in range(4):  # 16 has four digits in base 2, fewer in others
            inverse += mi.Float(remaining % base) * weight
            remaining, weight = remaining // base, weight * scale
        shifted = inverse + shift
        return dr.minimum(shifted - dr.floor(shifted), ONE_MINUS_EPSILON)

    def next_2d(self) -> Any:
        """mi.Point2f in [0, 1)^2."""
        return mi.Point2f(self.next_1d(), self.next_1d())
