"""SBF against a slow version in float64, and its estimate of the error against the error."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.filters.neighbours import mesh_variance
from models.filters.sbf import BANK, best_filtered, filter_with_risk, guides
from models.registry import create
from tests.helpers.frames import chain, flat_frame, run
from tests.models.conftest import MOSTLY_KERNELS

pytestmark = pytest.mark.usefixtures("implementation")


def naive_weight(features, sigma, p, q):
    """The paper's with σ_r = ∞; features (F, H, W) in units of √2 σ_f."""
    if max(abs(p[0] - q[0]), abs(p[1] - q[1])) > round(2 * sigma):
        return 0.0
    difference = features[:, *p] - features[:, *q]
    return math.exp(-((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2) / (2 * sigma**2) - difference @ difference)


def naive_mean(image, features, sigma, p):
    """The filtered image (C, H, W) at p, and the sum of weights."""
    weights = {q: naive_weight(features, sigma, p, q) for q in np.ndindex(image.shape[1:])}
    total = sum(weights.values())
    return sum(w * image[:, *q] for q, w in weights.items()) / total, total


def naive_best(colour, variance, features):
    size = colour.shape[1:]
    filtered = np.zeros((len(BANK), *colour.shape))
    risk = np.zeros((len(BANK), *size))
    for s, sigma in enumerate(BANK):
        for p in np.ndindex(size):
            filtered[s, :, *p], total = naive_mean(colour, features, sigma, p)
            c, v = colour[:, *p], variance[:, *p]
            risk[s, *p] = np.mean((filtered[s, :, *p] - c) ** 2 + 2 * v / total - v)
    best = np.zeros_like(colour)
    for p in np.ndindex(size):
        smoothed, _ = naive_mean(risk, features, 8.0, p)
        best[:, *p] = filtered[np.argmin(smoothed), :, *p]
    return best


def to_torch(array):
    return torch.from_numpy(np.float32(array))[None]


def inputs(rng, height, width):
    """Colour and the variance of its noise (3, H, W), features (7, H, W): float64 with the values of float32."""
    shapes = [(3, height, width), (3, height, width), (7, height, width)]
    return [np.float32(rng.random(shape)).astype(float) for shape in shapes]


@settings(max_examples=10, deadline=None)
@given(size=st.tuples(st.integers(1, 9), st.integers(1, 9)), seed=st.integers(0, 999))
def test_the_best_filter_is_chosen(size, seed):
    colour, variance, features = inputs(np.random.default_rng(seed), *size)
    filtered = best_filtered(*map(to_torch, (colour, variance, features)))
    np.testing.assert_allclose(filtered[0], naive_best(colour, variance, features), rtol=1e-4)


def test_windows_larger_than_a_strip_of_rows():
    """Windows wider than the images above, over several strips."""
    colour, variance, features = inputs(np.random.default_rng(0), 37, 21)
    filtered, _ = filter_with_risk(*map(to_torch, (colour, variance, features)), BANK)
    for p in ((0, 0), (15, 20), (16, 3), (18, 10), (36, 0)):
        for s, sigma in enumerate(BANK):
            expected, _ = naive_mean(colour, features, sigma, p)
            np.testing.assert_allclose(filtered[0, s, :, *p], expected, rtol=1e-5)


@MOSTLY_KERNELS
def test_the_risk_is_the_squared_error_on_average():
    """Over many images of the same truth: an edge in the features, one that is not, and noise that grows."""
    generator = torch.Generator().manual_seed(0)
    count, height, width = 1000, 6, 8
    truth = torch.linspace(0.2, 1, height)[:, None].repeat(3, 1, width).view(3, height, width)
    truth[..., 3:] += 1
    truth[..., 4:, :] *= 0.5
    features = torch.zeros(7, height, width)
    features[0, :, 3:] = 1
    deviation = torch.linspace(0.05, 0.8, width).expand(3, height, width)
    noise = torch.randn(count, 3, height, width, generator=generator)
    colour = truth + deviation * noise
    filtered, risk = filter_with_risk(
        colour, deviation.square().expand_as(colour), features.expand(count, -1, -1, -1), BANK
    )
    off = (risk - (filtered - truth).square()).double()
    standard_error = off.std(dim=0) / math.sqrt(count)
    assert (off.mean(dim=0).abs() < 5 * standard_error).all()


def test_features_are_in_units_of_the_paper_s_deviations():
    frame = flat_frame(1, 2)
    frame.channels.update(
        normal=torch.tensor([[0.0, 0.08], [0, 0], [-1, -1]])[None, :, None],
        albedo=torch.tensor([[0.5, 0.525], [0.5, 0.5], [0.5, 0.475]])[None, :, None],
        depth=torch.tensor([[4.7, 5.0]])[None, :, None],
    )
    squares = (guides(frame)[0, :, 0, 1] - guides(frame)[0, :, 0, 0]).square()
    torch.testing.assert_close(2 * squares, torch.tensor([1.0, 0, 0, 1, 0, 1, 1]))


def test_accumulated_light_is_filtered():
    """The second of two frames at rest: the filter's output for the mean of their light."""
    lights = torch.rand(2, 1, 3, 12, 14, generator=torch.Generator().manual_seed(0))
    frames = chain([flat_frame(12, 14, irradiance=light) for light in lights])
    _, second = run(create("sbf"), frames)
    mean, frame = lights.mean(dim=0), frames[1]
    expected = best_filtered(mean, mesh_variance(mean, frame.mesh_id), guides(frame))
    torch.testing.assert_close(second, expected)
    alone = best_filtered(lights[1], mesh_variance(lights[1], frame.mesh_id), guides(frame))
    assert not torch.allclose(second, alone, atol=1e-2)
