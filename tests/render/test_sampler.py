"""The sampler: stratified within a seed, uniform and independent between seeds."""

import numpy as np
import pytest

from render.backend import dr, mi
from render.sampler import HaltonSampler, Sampler, hash32, sobol_second_reversed


def sampler_points(key: int, count: int, skip: int = 0) -> np.ndarray:
    """The first `count` points (N, 2) of the sequence after `skip` others that `key` names."""
    sampler = Sampler(mi.UInt32(key), dr.arange(mi.UInt32, count), mi.UInt32(1))
    for _ in range(skip):
        sampler.next_2d()
    return np.array(sampler.next_2d()).T


@pytest.mark.parametrize("key", [0, 1, 0xFFFFFFFF, 123456789])
@pytest.mark.parametrize("bits", [0, 1, 4, 7])
def test_every_elementary_interval_holds_one_point(key, bits):
    p = sampler_points(key, 2**bits, skip=key % 3)
    for k in range(bits + 1):
        assert len({tuple(cell) for cell in (p * [2**k, 2 ** (bits - k)]).astype(int)}) == 2**bits


def test_second_dimension_is_sobol():
    """Unscrambled, the construction gives Sobol's second dimension, whose direction numbers follow a recurrence."""
    count = 256
    ours = np.array(dr.brev(sobol_second_reversed(dr.arange(mi.UInt32, count))), dtype=np.uint64)
    directions = [1 << 31]
    for _ in range(7):
        directions.append(directions[-1] ^ (directions[-1] >> 1))
    theirs = [np.bitwise_xor.reduce([0] + [d for k, d in enumerate(directions) if i >> k & 1]) for i in range(count)]
    assert ours.tolist() == [int(x) for x in theirs]


def test_single_samples_are_uniform_and_independent():
    """Chi-square of first samples over many seeds, and correlations between dimensions and neighbouring seeds."""
    count = 1 << 16
    sampler = Sampler(hash32(dr.arange(mi.UInt32, count)), mi.UInt32(0), mi.UInt32(1))
    dimensions = np.stack([*np.array(sampler.next_2d()), np.array(sampler.next_1d()), *np.array(sampler.next_2d())])
    assert (dimensions >= 0).all() and (dimensions < 1).all()
    for u in dimensions:
        chi2 = ((np.bincount((u * 64).astype(int), minlength=64) - count / 64) ** 2 / (count / 64)).sum()
        assert abs(chi2 - 63) < 5 * np.sqrt(2 * 63)
        assert abs(np.corrcoef(u[1:], u[:-1])[0, 1]) < 5 / np.sqrt(count)
    correlations = np.corrcoef(dimensions) - np.eye(len(dimensions))
    assert np.abs(correlations).max() < 5 / np.sqrt(count)


@pytest.mark.slow
def test_integrates_better_than_random():
    """A smooth integrand: the error of 256 samples over many seeds is far below that of independent samples."""
    x, y = np.moveaxis([sampler_points(key * 7919, 256) for key in range(200)], -1, 0)
    errors = (np.sin(np.pi * x) * y**2).mean(axis=1) - 2 / np.pi / 3
    variance = 0.5 * 0.2 - (2 / np.pi / 3) ** 2
    assert abs(errors.mean()) < 5 * errors.std() / np.sqrt(200)
    assert errors.var() < 0.01 * variance / 256


def test_halton_is_the_halton_sequence_shifted():
    """Against SciPy's, unscrambled: the difference is one number for each dimension and pixel."""
    from scipy.stats import qmc

    count = 16
    sampler = HaltonSampler(mi.UInt32(77), dr.arange(mi.UInt32, count), mi.UInt32(1))
    ours = np.stack([np.array(sampler.next_1d()) for _ in range(6)], axis=1).astype(float)
    shift = np.mod(ours - qmc.Halton(6, scramble=False).random(count), 1)
    np.testing.assert_allclose(np.mod(shift - shift[0] + 0.5, 1), 0.5, atol=1e-6)
    assert len(np.unique(shift[0].round(6))) == 6
    again = HaltonSampler(mi.UInt32(77), dr.arange(mi.UInt32, count) + 16, mi.UInt32(1))
    assert np.array_equal(np.array(again.next_1d()), ours[:, 0].astype(np.float32))  # a cycle


def test_halton_is_uniform_over_pixels():
    sampler = HaltonSampler(hash32(dr.arange(mi.UInt32, 1 << 16)), mi.UInt32(3), mi.UInt32(2))
    values = np.array([np.array(sampler.next_1d()) for _ in range(6)])
    assert (values >= 0).all() and (values < 1).all()
    np.testing.assert_allclose(values.mean(axis=1), 0.5, atol=0.01)
    np.testing.assert_allclose(np.corrcoef(values), np.eye(6), atol=0.02)
