"""Textures and colours are deterministic, their reflectances exist, and textures repeat without a seam."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scenes.colours import MAX_REFLECTANCE, MIN_REFLECTANCE, colour, palette
from scenes.textures import PALETTE_SIZE, PATTERNS, TEXTURE_SIZE, gray_texture, texture
from tests.helpers.scenes import SEEDS


def within(values, low, high):
    return np.isfinite(values).all() and values.min() >= low - 1e-6 and values.max() <= high + 1e-6


@given(seed=SEEDS)
def test_texture(seed):
    a, b, other = (texture(np.random.default_rng(each)) for each in (seed, seed, seed + 1))
    assert a.shape == (TEXTURE_SIZE, TEXTURE_SIZE, 3) and a.dtype == np.float32
    assert within(a, MIN_REFLECTANCE, MAX_REFLECTANCE)
    assert np.array_equal(a, b) and not np.array_equal(a, other)


@given(seed=SEEDS, low=st.floats(0, 0.5), span=st.floats(0.01, 0.5))
def test_gray_texture_spans_its_range(seed, low, span):
    a, b = (gray_texture(np.random.default_rng(seed), low, low + span) for _ in range(2))
    assert a.shape == (TEXTURE_SIZE, TEXTURE_SIZE, 1) and a.dtype == np.float32 and np.array_equal(a, b)
    has_one_tone = a.min() == a.max()  # few patterns do, such as that of seed 86
    assert a.min() == pytest.approx(low, abs=1e-6)
    assert has_one_tone or a.max() == pytest.approx(low + span, abs=1e-6)


def test_gray_textures_mostly_vary():
    assert sum(np.ptp(gray_texture(np.random.default_rng(seed), 0, 1)) == 1 for seed in range(40)) >= 38


@settings(max_examples=10)
@given(seed=SEEDS)
@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_stay_in_the_palette_and_show_something(pattern, seed):
    tone, shade = pattern(np.random.default_rng(seed))
    assert tone.shape == shade.shape == (TEXTURE_SIZE, TEXTURE_SIZE)
    assert within(tone, 0, PALETTE_SIZE - 1) and np.isfinite(shade).all()
    assert 0.5 < shade.mean() < 1.5
    # Of stripes, 0.2 % have a single tone.
    assert max(np.ptp(np.multiply(*pattern(np.random.default_rng([seed, n])))) for n in range(3)) > 0.01


@pytest.mark.parametrize("pattern", PATTERNS)
def test_patterns_repeat_seamlessly(pattern):
    """Neighbours across the border differ about as much as elsewhere at most, over many drawings."""
    inside, across = [], []
    for seed in range(20):
        tone = pattern(np.random.default_rng(seed)).tone
        for field in (tone, tone.T):
            steps = np.abs(field - np.roll(field, 1, axis=1)).mean(axis=0)
            inside.append(steps[1:].max())
            across.append(steps[0])
    assert (np.array(across) <= 1.5 * np.array(inside) + 1e-9).all()


@settings(max_examples=50)
@given(seed=SEEDS, count=st.integers(1, 8))
def test_colours(seed, count):
    colours = palette(np.random.default_rng(seed), count)
    assert colours.shape == (count, 3) and within(colours, MIN_REFLECTANCE, MAX_REFLECTANCE)
    assert np.array_equal(colours, palette(np.random.default_rng(seed), count))
    single = colour(np.random.default_rng(seed))
    assert len(single) == 3 and all(type(value) is float for value in single)
    assert within(np.array(single), MIN_REFLECTANCE, MAX_REFLECTANCE)


def test_colours_are_varied():
    rng = np.random.default_rng(0)
    luminance = np.array([colour(rng) for _ in range(500)]) @ [0.2126, 0.7152, 0.0722]
    assert luminance.min() < 0.05 and luminance.max() > 0.8 and 0.2 < luminance.mean() < 0.5
