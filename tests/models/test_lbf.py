"""LBF: its filter and that one's gradient, what its network sees, and its spikes, against slow versions in float64."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from models import registry
from models.compiled.cross_bilateral import FEATURE_GROUPS
from models.history.running_scale import running_scale
from models.networks.lbf import Pixels, cross_bilateral, features_of, remove_spikes, secondary_features
from tests.helpers.frames import flat_frame
from tests.helpers.windows import window

both_implementations = pytest.mark.usefixtures("implementation")
SIZES = st.tuples(st.integers(1, 7), st.integers(1, 7))
CHANNELS = sum(FEATURE_GROUPS)


def random_pixels(seed: int, height: int, width: int, batch: int = 1) -> tuple[Pixels, Tensor]:
    """Bright noise, features, surfaces with holes, and filters of all widths."""
    generator = torch.Generator().manual_seed(seed)

    def image(channels: int) -> Tensor:
        return torch.rand(batch, channels, height, width, generator=generator)

    pixels = Pixels(10 * image(3) ** 4, image(3), image(CHANNELS), (image(1) < 0.8).float())
    return pixels, 10 ** (3 * image(1 + len(FEATURE_GROUPS)) - 2)


# --- The filter -------------------------------------------------------------------------------------------------------


def all_at_once(pixels: Pixels, sharpness: Tensor) -> Tensor:
    """The filter (3, H, W) as matrices of all pixels by all others, which autograd differentiates; small images."""
    image, variance, features, surface, s = (tensor[0].double().flatten(1) for tensor in (*pixels, sharpness))
    height, width = pixels.surface.shape[-2:]
    place = torch.cartesian_prod(torch.arange(height), torch.arange(width)).double().T
    parts = [place, *features.split(FEATURE_GROUPS)]
    squares = torch.stack([(part[:, :, None] - part[:, None]).square().sum(dim=0) for part in parts])
    noise = variance[:, :, None] + variance[:, None]
    apart = ((image[:, :, None] - image[:, None]).square() / noise).sum(dim=0) / (2 * 7**2)
    weight = torch.exp(-(apart + (s[:, :, None] * squares).sum(dim=0))) * surface
    filtered = (image @ weight.T) / weight.sum(dim=1).clamp(min=1e-300) * surface
    return filtered.unflatten(1, (height, width))


@both_implementations
@settings(max_examples=15, deadline=None)
@given(size=SIZES, seed=st.integers(0, 999))
def test_the_filter_is_the_paper_s(size, seed):
    pixels, sharpness = random_pixels(seed, *size)
    filtered = cross_bilateral(pixels, sharpness)
    torch.testing.assert_close(filtered[0].double(), all_at_once(pixels, sharpness), rtol=1e-4, atol=1e-5)


@both_implementations
def test_windows_are_55_pixels_wide():
    """A pixel of light reaches 27 pixels."""
    pixels, sharpness = random_pixels(0, 1, 70)
    image = torch.zeros(1, 3, 1, 70)
    image[..., 35] = 1.0
    pixels = Pixels(image, torch.ones_like(image), torch.zeros(1, CHANNELS, 1, 70), torch.ones(1, 1, 1, 70))
    filtered = cross_bilateral(pixels, torch.zeros_like(sharpness))
    lit = torch.arange(70).sub(35).abs() <= 27
    assert torch.equal(filtered[0, 0, 0] > 0, lit)


@both_implementations
def test_the_gradient_is_autograd_s():
    pixels, sharpness = random_pixels(2, 9, 11, batch=2)
    sharpness = (sharpness / 10).requires_grad_()
    weights = torch.rand(pixels.image.shape, generator=torch.Generator().manual_seed(0))
    (weights * cross_bilateral(pixels, sharpness)).sum().backward()
    found = sharpness.grad
    sharpness.grad = None
    for item in range(2):
        each = Pixels(*(tensor[item : item + 1] for tensor in pixels))
        (weights[item] * all_at_once(each, sharpness[item : item + 1])).sum().backward()
    assert found is not None and sharpness.grad is not None and found.abs().max() > 1
    torch.testing.assert_close(found, sharpness.grad, rtol=1e-3, atol=1e-4)


@both_implementations
def test_gradients_stay_finite_at_the_extremes():
    """Colours without noise, features far apart, and no surface at all."""
    pixels, sharpness = random_pixels(3, 6, 7)
    extremes = [
        pixels._replace(variance=torch.zeros(1, 3, 6, 7), image=1e16 * pixels.image),
        pixels._replace(features=1e3 * pixels.features),
        pixels._replace(surface=torch.zeros(1, 1, 6, 7)),
    ]
    for extreme in extremes:
        sharpness = (1e4 * sharpness).detach().requires_grad_()
        filtered = cross_bilateral(extreme, sharpness)
        (filtered / 1e16).sum().backward()
        assert torch.isfinite(filtered).all() and torch.isfinite(sharpness.grad).all()
        assert filtered.min() >= 0 and (filtered.amax((2, 3)) <= extreme.image.amax((2, 3)) * (1 + 1e-5)).all()


# --- Secondary features -----------------------------------------------------------------------------------------------


def naive_noise(f, shown, p):
    """The MAD of one channel, of 16 details around p, in an image of even sides that ends in copies of itself."""
    height, width = np.array(f.shape) // 2
    details = []
    for i in range(-2, 2):
        for j in range(-2, 2):
            y = 2 * min(max(p[0] // 2 + i, 0), height - 1)
            x = 2 * min(max(p[1] // 2 + j, 0), width - 1)
            cell = f[y : y + 2, x : x + 2]
            whole = shown[y : y + 2, x : x + 2].all()
            details.append(whole * abs(cell[0, 0] + cell[1, 1] - cell[0, 1] - cell[1, 0]) / 2)
    return np.median(details) / 0.6745


def naive_statistics(f, shown, p):
    """Of one channel at p: MAD, mean deviation, gradient, deviation, mean, as secondary_features has them."""
    around = [q for q in window(f.shape, p, 3) if shown[q]]
    near = [f[q] for q in window(f.shape, p, 1) if shown[q]]
    gradient = np.zeros(2)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            q = p[0] + dy, p[1] + dx
            there = f[q] if q in around else f[p]
            gradient += np.array([dy * (2 - abs(dx)), dx * (2 - abs(dy))]) * there / 8
    return (
        max(naive_noise(f, shown, q) for q in window(f.shape, p, 1)),
        np.mean(np.abs(near - np.mean(near))),
        np.hypot(*gradient),
        np.std([f[q] for q in around], ddof=1) if len(around) > 1 else 0.0,
        np.mean([f[q] for q in around]),
    )


@settings(max_examples=10, deadline=None)
@given(size=st.tuples(st.sampled_from([2, 4, 10]), st.sampled_from([2, 8])), seed=st.integers(0, 999))
@example(size=(2, 2), seed=560)  # a pixel by itself, which has no spread
def test_the_network_sees_the_statistics_of_the_paper(size, seed):
    pixels, _ = random_pixels(seed, *size)
    variance = torch.rand(1, len(FEATURE_GROUPS), *size, generator=torch.Generator().manual_seed(seed))
    features = pixels.features * pixels.surface
    statistics = secondary_features(features, variance, pixels.surface, torch.full((1, 1, 1, 1), 4.0))[0].numpy()
    shown = pixels.surface[0, 0].numpy() > 0
    f = features[0].double().numpy()
    assert len(statistics) == 36
    for p in zip(*np.nonzero(shown), strict=True):
        by_channel = np.array([naive_statistics(channel, shown, p) for channel in f])
        by_group = np.array([part.mean(axis=0) for part in np.split(by_channel, np.cumsum(FEATURE_GROUPS)[:-1])])
        own = np.array([part[:, *p].mean() for part in np.split(f, np.cumsum(FEATURE_GROUPS)[:-1])])
        noise, apart, gradient, deviation, mean = by_group.T
        spreads = [noise, apart, gradient, np.sqrt(variance[0, :, *p].numpy()), deviation]
        expected = np.concatenate([np.log1p(np.concatenate(spreads) / 0.01), own, mean, [0.25]])
        np.testing.assert_allclose(statistics[:, *p], expected, rtol=1e-4, atol=1e-4)


def test_visibility_is_where_direct_light_arrives():
    """Half of a wall in shadow: 1, 0, and thirds of it between; its variance is that of the shares around."""
    frame = flat_frame(12, 20)
    frame.direct[..., 10:] = 0
    scale = running_scale(frame.direct, frame.depth, None)
    features, variance = features_of(frame, scale)
    torch.testing.assert_close(features[0, -1, 6, 8:12], torch.tensor([1.0, 2 / 3, 1 / 3, 0.0]))
    assert (variance[:, :-1] == 0).all()
    share = 5 / 9  # of the columns 5 to 13 around column 9, of which 5 to 9 are lit
    torch.testing.assert_close(variance[0, -1, 6, 9], torch.tensor(share * (1 - share) / 9))


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_units_of_length_do_not_matter(scale):
    frame = flat_frame(8, 9, depth=3.0 * scale)
    features, _ = features_of(frame, running_scale(frame.direct, frame.depth, None))
    x = (torch.arange(9) + 0.5 - 4.5) / 10.0  # the wall is a median depth away, the focal length 10 px
    torch.testing.assert_close(features[0, 0, 3], -x, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(features[0, 2], torch.ones(8, 9), rtol=1e-4, atol=1e-5)


# --- Spikes -----------------------------------------------------------------------------------------------------------


def naive_without_spikes(image, shown):
    out = image.copy()
    for p in zip(*np.nonzero(shown), strict=True):
        near = np.array([image[:, *q] for q in window(shown.shape, p, 1) if shown[q]])
        beside = np.array([image[:, *q] for q in window(shown.shape, p, 1) if shown[q] and q != p])
        if len(beside) < 2:
            continue
        if (np.abs(image[:, *p] - beside.mean(axis=0)) > 2 * beside.std(axis=0, ddof=1)).any():
            out[:, *p] = np.sort(near, axis=0)[len(near) // 2]
    return out


@settings(max_examples=30, deadline=None)
@given(size=SIZES, seed=st.integers(0, 999))
def test_spikes_become_medians(size, seed):
    pixels, _ = random_pixels(seed, *size)
    found = remove_spikes(pixels.image, pixels.surface)
    expected = naive_without_spikes(pixels.image[0].double().numpy(), pixels.surface[0, 0].numpy() > 0)
    np.testing.assert_allclose(found[0], expected, rtol=1e-6)


# --- The whole --------------------------------------------------------------------------------------------------------


def test_the_network_has_the_authors_shape():
    denoiser = registry.create("lbf")
    assert denoiser.parameter_count() == 36 * 10 + 10 + 10 * 6 + 6
    x = torch.randn(5, 36)
    first, _, last, _ = denoiser.network
    torch.nn.init.normal_(last.weight)  # which are 0 before training
    expected = torch.log1p(torch.exp(last(1 / (1 + torch.exp(-first(x))))))
    torch.testing.assert_close(denoiser.network(x), expected)


def test_before_training_widths_are_the_same_everywhere():
    """4 px, position 0.1, the others 0.2: with noise-free features, weights of e^-0.5 at these distances."""
    lbf = registry.create("lbf")
    generator = torch.Generator().manual_seed(0)
    features = torch.rand(1, sum(FEATURE_GROUPS), 12, 10, generator=generator)
    surface, variance = torch.ones(1, 1, 12, 10), torch.zeros(1, len(FEATURE_GROUPS), 12, 10)
    sharpness = lbf.sharpness(features, variance, surface, torch.ones(1, 1, 1, 1))
    expected = torch.tensor([1 / 32, 50, 12.5, 12.5, 12.5, 12.5]).view(1, 6, 1, 1).expand_as(sharpness)
    torch.testing.assert_close(sharpness, expected, rtol=1e-4, atol=0)


def test_accumulated_light_is_filtered():
    """As that of one frame which has it."""
    lights = torch.rand(2, 1, 3, 10, 10, generator=torch.Generator().manual_seed(0))
    frames = [flat_frame(10, 10, irradiance=light) for light in (*lights, lights.mean(dim=0))]
    lbf = registry.create("lbf")
    state = lbf(frames[0], None)[1]
    history = lbf.accumulate(frames[1], state)
    torch.testing.assert_close(history.history.irradiance, lights.mean(dim=0))
    accumulated, _ = lbf.filter(frames[2], history.history.irradiance, history.scale)
    alone, _ = lbf.filter(frames[2], frames[2].irradiance("total"), history.scale)
    torch.testing.assert_close(accumulated, alone)
