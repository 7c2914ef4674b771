"""Random numbers as a pure function of (pixel, seed, sample index, dimension), without state.

Every pair of dimensions is a (0, 2)-sequence of its own: the first two Sobol dimensions, Owen-scrambled by hashing and
visited in an Owen-shuffled order (Burley 2020, "Practical Hash-based Owen Scrambling", JCGT 9(4), §3). A single sample
is uniform and independent of other seeds; many samples of one seed are stratified.
"""

import numpy as np

from render.backend import dr, mi

ONE_MINUS_EPSILON = float(np.nextafter(np.float32(1), np.float32(0)))
GOLDEN_RATIO = 0x9E3779B9  # its fractional part times 2^32 spreads small integers over all 32 bits


def hash32(x: mi.UInt32) -> mi.UInt32:
    """The output permutation of PCG (O'Neill 2014, RXS M XS 32) as an integer hash."""
    x = x * 747796405 + 2891336453
    x = ((x >> ((x >> 28) + 4)) ^ x) * 277803737
    return (x >> 22) ^ x


def scramble_reversed(x: mi.UInt32, seed: mi.UInt32) -> mi.UInt32:
    """Owen scrambling of a bit-reversed integer: the Laine-Karras permutation with Vegdahl's (2021) constants."""
    x = x ^ (x * 0x3D20ADEA)
    x = x + seed
    x = x * ((seed >> 16) | 1)
    x = x ^ (x * 0x05526C56)
    return x ^ (x * 0x53A22864)


def sobol_second_reversed(index: mi.UInt32) -> mi.UInt32:
    """The second Sobol dimension, bits reversed: `index` times Pascal's triangle mod 2, a Kronecker factor a line."""
    index = index ^ ((index & 0xAAAAAAAA) >> 1)
    index = index ^ ((index & 0xCCCCCCCC) >> 2)
    index = index ^ ((index & 0xF0F0F0F0) >> 4)
    index = index ^ ((index & 0xFF00FF00) >> 8)
    return index ^ (index >> 16)


def to_unit(x: mi.UInt32) -> mi.Float:
    """Floats in [0, 1) from 32-bit integers."""
    return mi.Float(x >> 8) * 2**-24


class Sampler:
    """Owen-scrambled Sobol numbers for one bounce: each call of `next_1d` or `next_2d` takes the next dimensions.

    `key`, a hash of pixel and seed, and `depth`, the bounce counted from 1, identify the sequences; the sample `index`
    is the point in them.
    """

    def __init__(self, key: mi.UInt32, index: mi.UInt32, depth: mi.UInt32):
        self.key = hash32(key ^ depth)
        self.reversed_index = dr.brev(index)
        self.dimension = 0

    def _next(self) -> tuple[mi.UInt32, mi.UInt32]:
        """The shuffled index in the next sequence, and its seed."""
        self.dimension += 1
        seed = hash32(self.key ^ mi.UInt32(self.dimension * GOLDEN_RATIO & 0xFFFFFFFF))
        return dr.brev(scramble_reversed(self.reversed_index, seed)), seed

    def next_1d(self) -> mi.Float:
        """A number in [0, 1)."""
        index, seed = self._next()
        return to_unit(dr.brev(scramble_reversed(index, hash32(seed + 1))))

    def next_2d(self) -> mi.Point2f:
        """A point in [0, 1)^2."""
        index, seed = self._next()
        x = dr.brev(scramble_reversed(index, hash32(seed + 1)))
        y = dr.brev(scramble_reversed(sobol_second_reversed(index), hash32(seed + 2)))
        return mi.Point2f(to_unit(x), to_unit(y))


CYCLE = 16  # points, one a frame
PRIMES = (  # bases: a row for each bounce, a column for each of its six numbers
    (2, 3, 5, 7, 11, 13),
    (17, 19, 23, 29, 31, 37),
    (41, 43, 47, 53, 59, 61),
    (67, 71, 73, 79, 83, 89),
)


class HaltonSampler(Sampler):
    """Point `index` mod 16 of the Halton sequence, with a random shift (mod 1) for each pixel that `key` determines.

    Real-time renderers draw one point of the cycle a frame (SVGF §3, RAE §3.1): each frame is unbiased, and the mean of
    16 consecutive ones is less noisy than that of independent ones. Bounces from the fifth on repeat the primes with
    other shifts.
    """

    def __init__(self, key: mi.UInt32, index: mi.UInt32, depth: mi.UInt32):
        super().__init__(key, index, depth)
        self.index = index & (CYCLE - 1)
        self.bounce = (depth - 1) & (len(PRIMES) - 1)

    def next_1d(self) -> mi.Float:
        base = mi.UInt32(PRIMES[0][self.dimension])
        for bounce in range(1, len(PRIMES)):
            base = dr.select(self.bounce == bounce, PRIMES[bounce][self.dimension], base)
        shift = to_unit(hash32(self.key ^ mi.UInt32(self.dimension * GOLDEN_RATIO & 0xFFFFFFFF)))
        self.dimension += 1

        scale = dr.rcp(mi.Float(base))
        weight = scale
        remaining = self.index
        inverse = mi.Float(0)
        for _ in range(4):  # digits of 15 in base 2; fewer in others
            inverse += mi.Float(remaining % base) * weight
            remaining = remaining // base
            weight = weight * scale
        shifted = inverse + shift
        return dr.minimum(shifted - dr.floor(shifted), ONE_MINUS_EPSILON)

    def next_2d(self) -> mi.Point2f:
        return mi.Point2f(self.next_1d(), self.next_1d())
