"""Glass in two layers: kernels against PyTorch, energy, missing samples, and every denoiser on such frames."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from datasets.channels import SECOND
from datasets.frame import Frame
from eval.stress.check import ROUNDING
from models import compiled, layers, registry
from models.denoiser import LayeredState
from models.registry import DENOISERS
from tests.helpers.denoisers import each
from tests.helpers.frames import flat_frame, play, prepared, run

SIZE = (23, 37)  # odd: blocks of the last row and column are not whole
MAIN, SECOND_LIGHT = 2.0, 5.0  # irradiance


def glass_frame(seed: int, reflectance: float = 0.2, noise: float = 0.0, size: tuple[int, int] = SIZE) -> Frame:
    """A white wall of which a rectangle of glass shows two walls, each under even light, and a lamp."""
    generator = torch.Generator().manual_seed(seed)
    frame = flat_frame(*size)
    glass = torch.zeros(1, 1, *size)
    glass[..., 3:-4, 5:-6] = 1
    second = (torch.rand(1, 1, *size, generator=generator) < reflectance) * glass
    exponential = -torch.rand(2, 1, 3, *size, generator=generator).clamp(min=1e-3).log()
    light, other = 1 - noise + noise * exponential
    albedo = 0.5 + 0.4 * torch.rand(1, 3, *size, generator=generator)
    own = {"albedo": torch.where(glass > 0, 0.8, 1.0).expand(1, 3, -1, -1).contiguous(), "mesh_id": 1 + glass}
    channels = {
        **own,
        "direct": MAIN * light * own["albedo"] * (1 - glass),
        "indirect": glass * torch.where(second > 0, SECOND_LIGHT * albedo * other, MAIN * light * own["albedo"]),
        "emission": 0.5 * glass.expand(1, 3, -1, -1),
        SECOND["indirect"]: second * SECOND_LIGHT * albedo * other,
        "second_samples": second,
        "glass_reflectance": reflectance * glass,
        SECOND["albedo"]: torch.where(glass > 0, albedo, 1.0),
        SECOND["depth"]: 3 * glass,
        SECOND["mesh_id"]: 3 * glass,
        SECOND["normal"]: frame.normal * glass,
        SECOND["roughness"]: torch.ones_like(glass),
        SECOND["motion"]: frame.motion,
    }
    return frame.with_channels(channels)


def truth(frame: Frame) -> Tensor:
    """Radiance without noise."""
    share = frame.channel("glass_reflectance")
    main = MAIN * frame.albedo
    return main + share * (SECOND_LIGHT * frame.channel(SECOND["albedo"]) - main) + frame.emission


@settings(deadline=None)
@given(seed=st.integers(0, 1000), height=st.integers(9, 30), width=st.integers(13, 30))
def test_kernels_compute_what_pytorch_does(seed, height, width):
    frame = glass_frame(seed, noise=1.0, size=(height, width))
    share = layers.second_share(frame)

    def all_of_it() -> list[Tensor]:
        main, second = layers.main_layer(frame, share), layers.second_layer(frame, share)
        sums = layers.composed(main.indirect, second.indirect, share, frame.albedo, frame.emission)
        return [sums, *main.channels.values(), *second.channels.values()]

    ours = all_of_it()
    with compiled.disabled():
        expected = all_of_it()
    torch.testing.assert_close(ours, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("share", [0.02, 0.2, 0.5])
def test_even_light_is_kept_however_few_samples_a_layer_has(share):
    """Pixels without samples of a layer are not black: a filter of each layer apart returns the mean of all samples."""
    frame = glass_frame(0, share)
    (output,) = run(registry.create("accumulated"), [frame])
    torch.testing.assert_close(output, truth(frame), rtol=1e-4, atol=1e-4)


def test_each_layer_has_the_light_of_its_samples():
    frame = glass_frame(3, 0.3, noise=1.0)
    share = layers.second_share(frame)
    main = layers.main_layer(frame, share)
    sampled = (share > 0) & (frame.channel("second_samples") == 0)
    torch.testing.assert_close(main.indirect * sampled, frame.indirect * sampled)
    assert torch.equal(main.indirect * (share == 0), frame.indirect * (share == 0))
    second = layers.second_layer(frame, share)
    weights = layers.second_samples(
        frame.channel(SECOND["indirect"]), frame.channel("second_samples"), share, frame.channel(SECOND["albedo"])
    )[1]
    mean = (second.irradiance("total") * weights).sum() / weights.sum() / 3
    light = frame.channel(SECOND["indirect"]) / frame.channel(SECOND["albedo"])
    torch.testing.assert_close(mean, light.sum() / frame.channel("second_samples").sum() / 3)


def test_half_the_resolution_keeps_the_geometry():
    """A point of the second layer projects to half its pixel."""
    frame = glass_frame(0)
    half = layers.halved(frame.now)
    points = torch.tensor([[0.3, -0.2, 2.0]], dtype=torch.float64)
    pixels = [(points @ cameras.K[0].T)[:, :2] / points[:, 2:] for cameras in (frame.now, half)]
    torch.testing.assert_close(pixels[1], pixels[0] / 2)


def test_blended_guides_are_weighted_by_probability():
    frame = glass_frame(0, 0.25)
    blend = layers.blended(frame)
    expected = 0.75 * frame.albedo + 0.25 * frame.channel(SECOND["albedo"])
    glass = frame.channel("glass_reflectance") > 0
    torch.testing.assert_close(blend.albedo * glass, expected * glass)
    assert torch.equal(blend.albedo * ~glass, frame.albedo * ~glass) and not blend.has_layers


@pytest.mark.parametrize("name", each((*DENOISERS, "eaw+adaptive", "svgf+js", "one+taa")))
def test_every_denoiser_takes_both_layers(name):
    """Convex filters return no irradiance beyond that of the samples of each layer; the state is of both layers."""
    denoiser = prepared(name)
    frames = [glass_frame(seed, noise=1.0) for seed in range(1 if denoiser.offline else 2)]
    outputs, state = play(denoiser, frames)
    assert state is not None
    for frame, output in zip(frames, outputs, strict=True):
        assert torch.isfinite(output).all() and output.shape == frame.emission.shape
        if denoiser.convex and not denoiser.blends_layers:
            brightest = max(float((each.direct + each.indirect).max() / 0.5) for each in frames)
            assert output.max() <= (brightest + 0.5) * (1 + ROUNDING)
    if not denoiser.blends_layers and not hasattr(denoiser, "inner"):
        assert isinstance(state, LayeredState)
    assert type(state.pictures()) is dict
