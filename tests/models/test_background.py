"""Background reflects nothing: it is black in the output, and no surface gathers from it."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.frame import Frame
from models import registry
from models.history.running_scale import running_scale
from models.networks.ntd import reconstruct_image
from models.operators import halve, halve_surface
from tests.helpers.denoisers import each
from tests.helpers.frames import chain, flat_frame, play, prepared, run

NAMES = [name for name in registry.DENOISERS if not registry.prototype(name).unavailable()]
# Regressions and combinations of resolutions or grids may have weights below 0, whose sum is 1 nevertheless.
AFFINE = ("bmfr", "nfor", "wskp-mr", "mr-kp", "nbgd")
KEEP_EVEN_LIGHT = [name for name in NAMES if registry.prototype(name).convex or name in AFFINE]
MASKS = st.builds(
    lambda height, width, share, seed: (
        torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(seed)) < share
    ),
    st.integers(1, 40),
    st.integers(1, 20),
    st.sampled_from([0.0, 0.02, 0.5, 0.98]),
    st.integers(0, 9999),
)


def with_background(frame: Frame, surface: torch.Tensor) -> Frame:
    """The frame with sky, lit by an emission of 3, where `surface` (1, 1, H, W) is false."""
    sky = dict.fromkeys(("direct", "indirect", "normal", "depth", "mesh_id"), 0.0)
    sky |= {"emission": 3.0, "albedo": 1.0, "roughness": 1.0}
    cut = {name: torch.where(surface, frame.channels[name], value) for name, value in sky.items()}
    return frame.with_channels(cut)


def noisy_frames(surface: torch.Tensor, count: int = 3) -> list[Frame]:
    """A camera that slides along a noisy wall with holes, with sky behind; always the same."""
    generator = torch.Generator().manual_seed(0)
    height, width = surface.shape[-2:]
    frames = []
    for _ in range(count):
        light = torch.rand(1, 3, height, width, generator=generator) ** 4 * 10
        frame = flat_frame(height, width, (0.3, -0.2), irradiance=light)
        frame.channels.update(indirect=light.flip(1))
        frames.append(with_background(frame, surface))
    return chain(frames)


def both_implementations(test: Callable[..., None]) -> Callable[..., None]:
    """With kernels, which denoisers take, and in test-all in PyTorch as well."""
    values = ["kernels", pytest.param("PyTorch", marks=pytest.mark.slow)]
    parametrized = pytest.mark.parametrize("implementation", values, indirect=True)(test)
    return pytest.mark.usefixtures("implementation")(parametrized)


# --- All denoisers ----------------------------------------------------------------------------------------------------


@both_implementations
@pytest.mark.parametrize("name", each(name for name in NAMES if not registry.prototype(name).filters_emission))
def test_background_is_its_emission_alone(name):
    denoiser = prepared(name)
    surface = torch.rand(1, 1, 40, 37) < 0.5
    emission = 3.0 if denoiser.signal == "total" else 0.0
    outputs, state = play(denoiser, noisy_frames(surface))
    for output in outputs:
        assert (output.masked_select(~surface) == emission).all()
        assert output.masked_select(surface).max() > 0
    carried = getattr(state, "irradiance", None)
    if carried is not None:
        assert (carried.masked_select(~surface) == 0).all()


@both_implementations
@pytest.mark.parametrize("name", each(KEEP_EVEN_LIGHT))
@settings(deadline=None)
@given(surface=MASKS)
def test_even_light_stays_even_beside_background(name, surface):
    light = torch.full((1, 3, *surface.shape[-2:]), 7.0)
    frame = with_background(flat_frame(*surface.shape[-2:], irradiance=light), surface)
    denoiser = prepared(name)
    for output in run(denoiser, [frame] * (1 if denoiser.offline else 3)):
        torch.testing.assert_close(output, torch.where(surface, 7.0, 3.0).expand_as(output), rtol=2e-5, atol=0)


@both_implementations
@pytest.mark.parametrize("name", ["accumulated", "eaw", "svgf"])
def test_beside_background_is_like_beside_the_border(name):
    """Sky right of a wall filters it as an image that ends there does."""
    surface = torch.ones(1, 1, 40, 70, dtype=torch.bool)
    surface[..., 43:] = False
    frames = noisy_frames(surface, count=5)
    whole = run(prepared(name), frames)
    # The cameras stay, because columns count from the left.
    alone = run(prepared(name), [frame.map(lambda tensor: tensor[..., :43].contiguous()) for frame in frames])
    torch.testing.assert_close([output[..., :43] for output in whole], alone, rtol=1e-5, atol=1e-6)


# --- The operators of the networks ------------------------------------------------------------------------------------


@given(surface=MASKS)
def test_halving_takes_the_mean_of_surfaces(surface):
    image = torch.rand(1, 3, *surface.shape[-2:])
    half = halve(image, surface.float())
    there = halve_surface(surface.float())
    for y, x in np.ndindex(*half.shape[-2:]):
        block = (..., slice(2 * y, 2 * y + 2), slice(2 * x, 2 * x + 2))
        chosen = image[block][:, :, surface[0, 0][block[1:]]]
        assert bool(there[0, 0, y, x]) == bool(surface[block].any())
        expected = chosen.mean(dim=2) if chosen.numel() else torch.zeros(1, 3)
        torch.testing.assert_close(half[..., y, x], expected)


def network_like(name: str, height: int, width: int, generator: torch.Generator) -> list[torch.Tensor]:
    """What the pyramid networks predict, coarse to fine, at random."""
    channels = {"wskp-mr": (5, 5, 5), "ntd": (26, 26, 51)}[name]
    sizes = [(height // 4, width // 4), (height // 2, width // 2), (height, width)]
    return [torch.randn(1, c, *size, generator=generator) for c, size in zip(channels, sizes, strict=True)]


def reconstructed(name: str, image: torch.Tensor, past: torch.Tensor, predicted, surface) -> torch.Tensor:
    if name == "ntd":
        return reconstruct_image(image, past, predicted, surface)[0]
    return registry.create(name).reconstruct(image, predicted, surface)[0]


@both_implementations
@pytest.mark.parametrize("name", ["wskp-mr", "ntd"])
def test_pyramids_end_where_surfaces_do(name):
    """Sky right of a wall: the wall comes out as from an image that ends there."""
    generator = torch.Generator().manual_seed(0)
    surface = torch.zeros(1, 1, 24, 64)
    surface[..., :28] = 1
    predicted = network_like(name, 24, 64, generator)
    left = [maps[..., : maps.shape[-1] * 28 // 64] for maps in predicted]
    image = torch.rand(1, 3, 24, 64, generator=generator) * surface
    past = torch.rand(1, 3, 24, 64, generator=generator) * surface
    whole = reconstructed(name, image, past, predicted, surface)
    alone = reconstructed(name, image[..., :28], past[..., :28], left, None)
    torch.testing.assert_close(whole[..., :28], alone, rtol=1e-5, atol=1e-6)


@both_implementations
@settings(deadline=None)
@given(surface=MASKS, name=st.sampled_from(["wskp-mr", "ntd"]), seed=st.integers(0, 999))
def test_pyramids_keep_even_light_even(surface, name, seed):
    surface = surface.float().repeat_interleave(4, dim=-1).repeat_interleave(4, dim=-2)
    surface *= torch.rand(surface.shape, generator=torch.Generator().manual_seed(seed)) < 0.7
    predicted = network_like(name, *surface.shape[-2:], torch.Generator().manual_seed(seed))
    image = 7 * surface.expand(1, 3, *surface.shape[-2:])
    output = reconstructed(name, image, image, predicted, surface)
    torch.testing.assert_close(output * surface, image, rtol=2e-5, atol=0)


@both_implementations
def test_ntd_fetches_surfaces_alone():
    """A wall of even light that slides past sky by half a pixel: the history at its edge is as bright as elsewhere."""
    surface = torch.ones(1, 1, 16, 32, dtype=torch.bool)
    surface[..., 20:] = False
    light = torch.full((1, 3, 16, 32), 5.0)
    frame = flat_frame(16, 32, (0.5, 0.0)).with_channels({"direct": torch.zeros_like(light), "indirect": light})
    frames = chain([with_background(frame, surface)] * 2)
    _, state = play(prepared("ntd"), frames)
    visible = state.warped.masked_select(surface)
    torch.testing.assert_close(visible, torch.full_like(visible, 5.0), rtol=1e-5, atol=0)


@given(surface=MASKS, seed=st.integers(0, 999))
def test_running_scales_are_of_surfaces(surface, seed):
    """Against means over the surfaces of each block; what the background holds does not matter."""
    generator = torch.Generator().manual_seed(seed)
    depth = 4.0 * surface
    y = 10 ** torch.randn(surface.shape, generator=generator)
    light = torch.where(surface, y, 1e4)
    scale = running_scale(light.repeat(1, 3, 1, 1), depth, None)
    if not surface.any():
        assert scale.exposure().item() == pytest.approx(1)
        return
    height, width = surface.shape[-2:]
    means = []
    for top in range(0, height, 16):
        for left in range(0, width, 16):
            block = (0, 0, slice(top, top + 16), slice(left, left + 16))
            if surface[block].any():
                means.append(y[block][surface[block]].double().mean().item())
    floor = 1e-4 * np.mean(means)
    geometric = np.exp(np.mean(np.log(np.maximum(means, floor))))
    assert scale.exposure().item() == pytest.approx(0.18 / geometric, rel=1e-4)
