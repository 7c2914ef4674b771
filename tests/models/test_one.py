"""`one`: what it accumulates, when it forgets, what it does not depend on; the kernels against PyTorch."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from datasets.frame import BOUNDED, Frame, read_frame
from eval.bench.synthetic_frames import synthetic_frame
from models import compiled
from models.compiled.one import FEATURES
from models.denoiser import Denoiser
from models.history.geometry import GBuffer
from models.history.reprojection import reproject
from models.networks.one import One
from tests.helpers.frames import chain, flat_frame, play, prepared, run
from tests.helpers.unfold import taps
from tests.models.conftest import MOSTLY_KERNELS

SIZE = (24, 40)
BYTES_AT_720P = 150e6


def silent() -> One:
    """A network that says nothing: all its outputs are 0."""
    denoiser = One()
    for parameter in denoiser.parameters():
        parameter.data.zero_()
    denoiser.prepare()
    return denoiser


@pytest.fixture
def fresh() -> Denoiser:
    return prepared("one")


def noise(count: int, scale: float = 1.0) -> list[Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [scale * torch.rand(1, 3, *SIZE, generator=generator) for _ in range(count)]


def frames(
    images: list[Tensor], motion: tuple[float, float] = (0.0, 0.0), mesh_id: Tensor | None = None
) -> list[Frame]:
    return chain([flat_frame(*SIZE, motion, mesh_id=mesh_id, irradiance=image) for image in images])


def test_frames_count_by_their_samples():
    """Three samples, then one, then eight: the mean of all twelve, unless the network says otherwise."""
    images = noise(3)
    spp = (3.0, 1.0, 8.0)
    sequence = [replace(frame, spp=torch.full((1, 1, 1, 1), n)) for frame, n in zip(frames(images), spp, strict=True)]
    _, state = play(silent(), sequence)
    mean = sum(n * image for n, image in zip(spp, images, strict=True)) / 12
    torch.testing.assert_close(state.accumulated, mean)
    torch.testing.assert_close(state.length, torch.full((1, 1, *SIZE), 12.0))


def test_the_length_is_that_of_a_mean_with_as_little_noise(fresh):
    """Unequal weights: 1 / sum of their squares, whatever the network says."""
    images = noise(5)
    before = None
    weights: list[Tensor] = []
    for frame in frames(images):
        with torch.no_grad():
            _, before = fresh(frame, before)
        alpha = before.alpha[:, :1]
        weights = [weight * (1 - alpha) for weight in weights] + [alpha]
    assert ((before.alpha > 0.01) & (before.alpha < 0.99)).any()
    torch.testing.assert_close(sum(weights), torch.ones(1, 1, *SIZE))
    torch.testing.assert_close(before.length, 1 / sum(weight.square() for weight in weights), rtol=1e-4, atol=1e-4)


def test_where_nothing_was_found_history_has_no_weight(moving_clip, fresh):
    """Exactly the first frame's result where a cut or a disocclusion leaves nothing to go by."""
    first = read_frame(moving_clip, 0, fresh.reads)
    later = read_frame(moving_clip, 7, fresh.reads, previous=0)
    _, before = play(fresh, [first])
    _, found = reproject(later, before.output, GBuffer.of(first))
    _, after = play(fresh, [first, later])
    lost = ~found & (later.depth > 0)
    assert lost.any() and found.any()
    assert (after.alpha[lost.expand_as(after.alpha)] == 1).all()
    noisy = later.irradiance("total")
    torch.testing.assert_close(after.accumulated[lost.expand_as(noisy)], noisy[lost.expand_as(noisy)])


@pytest.mark.parametrize("unit", [1e-2, 1e2])
def test_units_of_length_do_not_matter(fresh, unit):
    sequences = [
        chain([flat_frame(*SIZE, (0.5, 0.25), depth=2.0 * each, irradiance=image) for image in noise(4)])
        for each in (1.0, unit)
    ]
    torch.testing.assert_close(*(run(fresh, sequence) for sequence in sequences), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("size", [(2, 2), (13, 7), (3, 1100), (41, 70)])
def test_kernels_are_pytorch_at_any_size(fresh, size):
    """Also where a row takes several chunks, and where the borders are repeated up to a multiple of 8."""
    sequence = [synthetic_frame(index, *size) for index in range(4)]
    fast, state = play(fresh, sequence)
    with compiled.disabled():
        slow, expected = play(fresh, sequence)
    torch.testing.assert_close(fast, slow, rtol=1e-4, atol=1e-4)
    for name in ("latent", "alpha", "length", "accumulated"):
        torch.testing.assert_close(getattr(state, name), getattr(expected, name), rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_a_still_wall_stays_what_it_is(fresh):
    """300 frames of even light, with a static camera: no drift."""
    image = 0.5 * torch.ones(1, 3, *SIZE)
    outputs = run(fresh, frames([image] * 300))
    for output in (outputs[0], outputs[10], outputs[-1]):
        torch.testing.assert_close(output, image, rtol=1e-4, atol=1e-4)


def test_the_state_is_small(fresh):
    _, state = play(fresh, frames(noise(1)))
    images = [state.output, state.accumulated, state.length, state.latent, state.alpha]
    tensors = [*images, state.gbuffer.depth, state.gbuffer.normal, state.gbuffer.mesh_id]
    bytes_a_pixel = sum(tensor.nbytes for tensor in tensors) / (SIZE[0] * SIZE[1])
    assert bytes_a_pixel * 1280 * 720 <= BYTES_AT_720P


def square(side: int) -> Tensor:
    """Ones in a square about the pixel (12, 20)."""
    image = torch.zeros(1, 3, *SIZE)
    image[..., 12 - side // 2 : 13 + side // 2, 20 - side // 2 : 21 + side // 2] = 1.0
    return image


TWO_MESHES = torch.where(torch.arange(SIZE[1]) < 30, 1, 2).expand(1, 1, *SIZE)  # the square's, and one to its right


def level(image: Tensor, step: int, guide: Tensor | None = None, strength: float = 0.0) -> Tensor:
    """Where the network says nothing, weights are even but for mesh and guide, with a sharpness of softplus(0)."""
    values = torch.zeros_like(image[:, :1]) if guide is None else guide
    there = taps(torch.cat([values, TWO_MESHES, torch.ones_like(values), image], dim=1), 3, step)
    distance = strength * (there[:, :1] - values[:, :, None]).square() + 2 * (there[:, 1:2] != TWO_MESHES[:, :, None])
    weights = 2.0**-distance * there[:, 2:3]
    return (there[:, 3:] * weights).sum(dim=2) / weights.sum(dim=2)


def filtered(light: Tensor, exposure: Tensor) -> Tensor:
    """Light (1, 2, H, W), grey and its weight, by all levels, and those that log luminance guides."""
    for step in (32, 16, 8, 4, 2, 1):
        light = level(light, step)
    for step in (64, 16, 4, 1):
        light = level(light, step, torch.log1p(100 * exposure * light[:, :1] / light[:, 1:]), 30)
    return light[:, :1] / light[:, 1:]


@pytest.mark.usefixtures("implementation")
def test_levels_follow_one_another_and_luminance_guides_the_last():
    image = 11 + 81 * square(5)  # no pixel is an outlier
    _, state = play(silent(), frames([image], mesh_id=TWO_MESHES))
    light = torch.cat([image[:, :1], torch.ones(1, 1, *SIZE)], dim=1)
    expected = filtered(light, state.scale.exposure())
    torch.testing.assert_close(state.output, expected.expand(1, 3, -1, -1))


@pytest.mark.usefixtures("implementation")
def test_outliers_are_spread():
    """What is beyond eight times the mean of 9 x 9 pixels passes through two levels more, with its weight."""
    outputs, state = play(silent(), frames([1 + 162 * square(1)], mesh_id=TWO_MESHES))
    centre = square(1)[:, :1]
    share = 139 / 163 * centre
    light = torch.cat([1 + 162 * centre, torch.ones_like(centre)], dim=1)
    outliers = level(level(share * light, 64), 16)
    expected = filtered((1 - share) * light + outliers, state.scale.exposure())
    torch.testing.assert_close(outputs[0], expected.expand(1, 3, -1, -1))


@pytest.mark.usefixtures("implementation")
def test_the_brightest_pixel_with_the_largest_weight_stays_finite(fresh):
    """Logits at their bounds, and light whose sum float32 could not hold."""
    fresh.network.leave.bias.data[FEATURES:] = 50.0
    images = [torch.full((1, 3, *SIZE), 3e38) for _ in range(3)]
    outputs, state = play(fresh, frames(images))
    assert all(torch.isfinite(output).all() for output in outputs)
    assert torch.isfinite(state.output).all() and torch.isfinite(state.accumulated).all()


@pytest.mark.usefixtures("implementation")
@MOSTLY_KERNELS
@pytest.mark.parametrize("name", BOUNDED)
def test_surfaces_count_as_at_most_100(fresh, name):
    """In a tenth of the pixels, also where a channel's sum shows nothing."""
    hit = torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(2)) < 0.1
    sequence = [synthetic_frame(index, *SIZE) for index in range(4)]
    for value in (1e35, -1e35, torch.tensor([1e35, -1e35]).repeat(SIZE[1] // 2)):
        huge = torch.as_tensor(value)
        outputs, expected = (
            run(fresh, [frame.with_channels({name: torch.where(hit, x, frame.channel(name))}) for frame in sequence])
            for x in (huge, huge.clamp(-100, 100))
        )
        assert all(torch.isfinite(output).all() for output in outputs)
        torch.testing.assert_close(outputs, expected, rtol=0, atol=0)


@pytest.mark.parametrize("height", [70, 200])
def test_the_network_works_on_strips_of_large_images(height, monkeypatch):
    """With history, and with strips that are thinner than what they depend on."""
    frames = [synthetic_frame(i, height, 48) for i in range(3)]
    denoiser = prepared("one")
    with torch.inference_mode():
        whole = run(denoiser, frames)
        monkeypatch.setattr("models.networks.one.STRIP_PIXELS", 24 * 48)
        strips = run(denoiser, frames)
    torch.testing.assert_close(strips, whole, rtol=1e-4, atol=1e-5)
