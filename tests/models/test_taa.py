"""Temporal antialiasing: constants, noise, ghosts, motion, tone mapping, and its wrapped denoiser."""

import pytest
import torch

from models.filters.baselines import Accumulated, Noisy
from models.networks.rae import RAE
from models.wrappers.taa import TAA, inverse_tone_map, max_3x3, tone_map
from tests.helpers.frames import chain, flat_frame, run


def run_chained(denoiser, frames):
    return run(denoiser, chain(frames))


def lit(light, **kwargs):
    return flat_frame(*light.shape[-2:], irradiance=light, **kwargs)


def noise(count, size=24, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return [lit(0.5 + torch.rand(1, 3, size, size, generator=generator)) for _ in range(count)]


@pytest.mark.parametrize("level", [0.0, 1e-7, 1.0, 65504.0])
@pytest.mark.parametrize("motion", [(0.0, 0.0), (0.4, -0.3)])
def test_a_constant_stays_what_it_is(level, motion):
    colour = level * torch.tensor([1.0, 0.5, 0.1])[None, :, None, None].expand(1, 3, 7, 9)
    for output in run_chained(TAA(Noisy()), [lit(colour, motion=motion) for _ in range(6)]):
        torch.testing.assert_close(output, colour, rtol=1e-5, atol=0)


def test_the_flicker_of_still_noise_falls():
    frames = noise(20)
    raw = run_chained(Noisy(), frames)
    smooth = run_chained(TAA(Noisy()), frames)
    flicker = [(a[-1] - a[-2]).abs().mean() for a in (raw, smooth)]
    assert flicker[1] < 0.3 * flicker[0]
    assert abs(smooth[-1].mean() - 1) < 0.05


def test_the_first_frame_and_one_of_a_new_size_are_unchanged():
    small = noise(2)
    large = noise(1, size=31)
    outputs = run_chained(TAA(Noisy()), [*small, *large])
    torch.testing.assert_close(outputs[0], small[0].direct)
    torch.testing.assert_close(outputs[2], large[0].direct)


def test_ghosts_are_clamped_to_the_neighbourhood():
    """A bright frame, then a dark one: nothing of the bright one remains, in any channel."""
    dark = 0.1 + 0.05 * torch.rand(1, 3, 12, 12, generator=torch.Generator().manual_seed(1))
    _, output = run_chained(TAA(Noisy()), [lit(torch.full((1, 3, 12, 12), 50.0)), lit(dark)])
    assert output.max() < 0.2 and output.min() > 0.05
    still, _ = run_chained(TAA(Noisy()), [lit(dark), lit(dark)])
    torch.testing.assert_close(still, dark)


def test_history_follows_the_motion():
    """An edge that moves by a whole pixel stays sharp; by half a pixel it is blended."""
    ramp = torch.where(torch.arange(16) < 8, 0.2, 1.0).expand(1, 3, 6, 16)
    moved = ramp.roll(1, dims=-1)
    moved[..., 0] = 0.2
    _, output = run_chained(TAA(Noisy()), [lit(ramp), lit(moved, motion=(-1.0, 0.0))])
    torch.testing.assert_close(output, moved, rtol=1e-4, atol=1e-5)
    _, output = run_chained(TAA(Noisy()), [lit(ramp), lit(ramp, motion=(0.5, 0.0))])
    assert 0.3 < output[0, 0, 3, 7] < 0.9


def test_off_screen_and_disoccluded_pixels_have_no_history():
    a, b = noise(2)
    frames = [a, lit(b.direct, motion=(6.0, 0.0))]
    plain = frames[1].direct
    output = run_chained(TAA(Noisy()), frames)[1]
    torch.testing.assert_close(output[..., 19:], plain[..., 19:])
    assert (output[..., :18] != plain[..., :18]).float().mean() > 0.9
    mesh = torch.ones(1, 1, 24, 24)
    mesh[..., 12:] = 2
    output = run_chained(TAA(Noisy()), [a, lit(b.direct, mesh_id=mesh)])[1]
    torch.testing.assert_close(output[..., 13:], b.direct[..., 13:])
    assert (output[..., :12] != b.direct[..., :12]).float().mean() > 0.9


def test_tone_mapping_is_inverted():
    rgb = torch.rand(1, 3, 5, 5) * 10 ** torch.linspace(-6, 10, 25).view(5, 5)
    error = (inverse_tone_map(tone_map(rgb)) - rgb).abs()
    assert (error <= 4 * torch.finfo().eps * rgb.amax(dim=1, keepdim=True)).all()  # channels are differences of others
    grey = tone_map(torch.full((1, 3, 1, 1), 3.0))
    torch.testing.assert_close(grey[0, :, 0, 0], torch.tensor([0.75, 0.0, 0.0, 0.25]))


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (6, 1), (7, 8)])
def test_the_maximum_is_that_of_nine_pixels(size):
    image = torch.randn(2, 4, *size)
    assert torch.equal(max_3x3(image), torch.nn.functional.max_pool2d(image, 3, 1, padding=1))


def test_it_shows_and_prepares_its_denoiser():
    _, state = TAA(Accumulated())(flat_frame(4, 4), None)
    assert list(state.pictures()) == ["history length"]
    network = TAA(RAE())
    network.prepare(torch.bfloat16)
    assert network.inner.precision == torch.bfloat16 and not network.inner.training
