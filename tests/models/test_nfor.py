"""NFOR step by step against slow versions in float64 that follow the paper pixel by pixel."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from models.filters.nfor import checkerboard_buffers, features_of, nfor, nl_means, patch_distances, regress
from tests.helpers.frames import flat_frame
from tests.helpers.windows import window

SIZES = st.tuples(st.integers(1, 6), st.integers(1, 6))
EXAMPLES = settings(max_examples=8, deadline=None)


# --- Slow versions ----------------------------------------------------------------------------------------------------


def naive_distance(guide, variance, surface, p, q, radius):
    """Of the patches around p and q, over pixels that are in the image and show surfaces in both."""
    apart = []
    there = window(surface.shape, q, radius)
    for n in window(surface.shape, p, radius):
        m = n[0] + q[0] - p[0], n[1] + q[1] - p[1]
        if m in there and surface[n] and surface[m]:
            v, w = variance[:, *n], variance[:, *m]
            apart += list(((guide[:, *n] - guide[:, *m]) ** 2 - v - np.minimum(v, w)) / (v + w))
    return max(np.mean(apart), 0)


def naive_weights(guide, variance, surface, radius, k):
    """By pixel, and by pixel in its window."""
    size = surface.shape
    return {
        p: {
            q: math.exp(-naive_distance(guide, variance, surface, p, q, radius) / k**2)
            for q in window(size, p, 9)
            if surface[q]
        }
        for p in np.ndindex(size)
        if surface[p]
    }


def naive_means(image, weights):
    out = np.zeros_like(image)
    for p, taps in weights.items():
        out[:, *p] = sum(w * image[:, *q] for q, w in taps.items()) / sum(taps.values())
    return out


def naive_regression(image, features, weights):
    """Fits by numpy's least squares, their ridge as further equations."""
    sums = np.zeros_like(image)
    total = np.zeros(image.shape[1:])
    for p, taps in weights.items():
        w = np.array(list(taps.values()))
        position = np.array([[q[0] - p[0], q[1] - p[1]] for q in taps]) / 9
        apart = np.array([features[:, *q] - features[:, *p] for q in taps])
        x = np.hstack([np.ones((len(w), 1)), position, apart])
        y = np.array([image[:, *q] for q in taps])
        ridge = math.sqrt(1e-5 * w.sum()) * np.eye(x.shape[1])[1:]
        equations = np.vstack([np.sqrt(w)[:, None] * x, ridge])
        right = np.vstack([np.sqrt(w)[:, None] * y, np.zeros((len(ridge), 3))])
        predicted = x @ np.linalg.lstsq(equations, right, rcond=None)[0]
        for q, weight, colour in zip(taps, w, predicted, strict=True):
            sums[:, *q] += weight * colour
            total[q] += weight
    return sums / np.where(total > 0, total, 1)


def naive_nfor(a, b, variance, features, surface):
    """The paper's pseudocode."""
    smoothing = naive_weights((a + b) / 2, variance, surface, 1, 1.0)
    passes = []
    for k in (0.5, 1.0):
        smooth_a = naive_regression(a, features, naive_weights(b, 2 * variance, surface, 3, k))
        smooth_b = naive_regression(b, features, naive_weights(a, 2 * variance, surface, 3, k))
        error_a = (b - smooth_a) ** 2 - 2 * variance
        error_b = (a - smooth_b) ** 2 - 2 * variance
        error = (error_a + error_b) / 2 - (smooth_b - smooth_a) ** 2 / 4
        passes.append((smooth_a, smooth_b, naive_means(error.mean(axis=0, keepdims=True), smoothing)))
    (a0, b0, error0), (a1, b1, error1) = passes
    chosen = naive_means((error1 < error0).astype(float), smoothing)
    result_a = (1 - chosen) * a0 + chosen * a1
    result_b = (1 - chosen) * b0 + chosen * b1
    mean = (result_a + result_b) / 2
    return naive_regression(mean, features, naive_weights(mean, (result_b - result_a) ** 2 / 4, surface, 3, 1.0))


def to_torch(array):
    return torch.from_numpy(np.float32(array))[None]


def to_numpy(tensor):
    return tensor[0].double().numpy()


def random_images(seed, height, width):
    """Two noisy colours, the variance of their mean, features, and which pixels show surfaces; as float32 has them."""
    rng = np.random.default_rng(seed)
    a, b, variance = np.float32(rng.random((3, 3, height, width))).astype(float)
    features = np.float32(rng.random((7, height, width))).astype(float)
    surface = rng.random((height, width)) < 0.8
    surface[rng.integers(height), rng.integers(width)] = True
    return a, b, 0.1 * variance + 0.01, features, surface


# --- Steps ------------------------------------------------------------------------------------------------------------


@EXAMPLES
@given(size=SIZES, seed=st.integers(0, 999), radius=st.sampled_from([1, 3]))
def test_weights_are_those_of_patches(size, seed, radius):
    a, _, variance, _, surface = random_images(seed, *size)
    distances = to_numpy(patch_distances(to_torch(a), to_torch(variance), to_torch(surface[None]), radius))
    weights = naive_weights(a, variance, surface, radius, 1.0)
    for number, tap in enumerate(np.ndindex(19, 19)):
        for p in np.ndindex(size):
            q = p[0] + tap[0] - 9, p[1] + tap[1] - 9
            expected = weights.get(p, {}).get(q, 0.0)
            assert math.exp(-distances[number, *p]) == pytest.approx(expected, rel=1e-4)


@EXAMPLES
@given(size=SIZES, seed=st.integers(0, 999), k=st.sampled_from([0.5, 1.0]))
def test_means_and_fits_are_weighted_by_distance(size, seed, k):
    a, b, variance, features, surface = random_images(seed, *size)
    distances = patch_distances(to_torch(b), to_torch(variance), to_torch(surface[None]), 3)
    weights = naive_weights(b, variance, surface, 3, k)
    means = nl_means(to_torch(a[:1]), distances, k)
    np.testing.assert_allclose(to_numpy(means), naive_means(a[:1], weights), rtol=1e-4)
    fitted = regress(to_torch(a), to_torch(features), distances, k)
    np.testing.assert_allclose(to_numpy(fitted), naive_regression(a, features, weights), rtol=1e-3, atol=1e-4)


@EXAMPLES
@given(size=SIZES, seed=st.integers(0, 999))
def test_the_whole_is_the_paper_s_pseudocode(size, seed):
    a, b, variance, features, surface = random_images(seed, *size)
    buffers = torch.stack([to_torch(a), to_torch(b)], dim=1)
    denoised = nfor(buffers, to_torch(variance), to_torch(features), to_torch(surface[None]))
    np.testing.assert_allclose(to_numpy(denoised), naive_nfor(a, b, variance, features, surface), rtol=2e-3, atol=2e-4)


def test_images_larger_than_windows():
    """An image that is linear in features and position is reproduced, whatever the weights."""
    rng = np.random.default_rng(0)
    features = rng.uniform(-1, 1, (7, 24, 40))
    y, x = np.mgrid[:24, :40]
    slopes = rng.uniform(-1, 1, (3, 9))
    image = 5 + np.tensordot(slopes, np.concatenate([features, [y / 9, x / 9]]), 1)
    distances = patch_distances(
        to_torch(rng.random((3, 24, 40))), torch.full((1, 3, 24, 40), 0.1), torch.ones(1, 1, 24, 40), 3
    )
    fitted = regress(to_torch(image), to_torch(features), distances, 1.0)
    np.testing.assert_allclose(to_numpy(fitted), image, rtol=1e-3, atol=1e-3)


# --- Buffers A and B --------------------------------------------------------------------------------------------------


def test_buffers_share_no_sample():
    """A sample contributes to one buffer alone, at its pixel and beside it."""
    mesh = torch.ones(1, 1, 6, 7)
    colour = torch.rand(1, 3, 6, 7)
    before = checkerboard_buffers(colour, mesh)
    for y, x in np.ndindex(6, 7):
        moved = colour.clone()
        moved[..., y, x] += 1
        off = checkerboard_buffers(moved, mesh) - before
        own = (y + x) % 2
        assert (off[:, 1 - own] == 0).all()
        changed = {tuple(place) for place in off[0, own, 0].nonzero().tolist()}
        assert changed == {(j, i) for j, i in np.ndindex(6, 7) if abs(j - y) + abs(i - x) <= 1}


def test_buffers_average_within_a_mesh():
    mesh = torch.tensor([[1, 1, 2, 2], [1, 3, 2, 2.0]])[None, None]
    colour = mesh.repeat(1, 3, 1, 1)
    assert (checkerboard_buffers(colour, mesh) == colour[:, None]).all()  # the only pixel of mesh 3 is in both
    assert checkerboard_buffers(torch.ones(1, 3, 1, 1), torch.ones(1, 1, 1, 1)).eq(1).all()


def test_features_stay_within_one():
    frame = flat_frame(2, 2, depth=50.0)
    frame.channels["albedo"] = torch.full((1, 3, 2, 2), 9.0)
    frame.channels["depth"][..., 0, 0] = 20.0
    features = features_of(frame)
    assert features.shape == (1, 7, 2, 2) and features.abs().max() == 1
    torch.testing.assert_close(features[0, 6], torch.tensor([[0.4, 1], [1, 1]]))
