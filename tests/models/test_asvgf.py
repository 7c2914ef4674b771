"""A-SVGF: SVGF where light stays, and mostly the newest frame where it changes."""

import numpy as np
import pytest
import torch

from models.filters.asvgf import ASVGF, STRATUM, change_of_light, repeat_strata, strata_centres, strata_sums
from models.filters.svgf import SVGF, SVGFState
from tests.helpers.frames import chain, flat_frame, play, run

SIZE = 24


def noise(count: int, level: float = 1.0, seed: int = 0) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return [level * 2 * torch.rand(1, 1, SIZE, SIZE, generator=generator).repeat(1, 3, 1, 1) for _ in range(count)]


def with_gradient(frame, difference: float, largest: float, where=(slice(None), slice(None))):
    """The frame with one sample in the middle of each stratum of a region (in strata)."""
    gradient = torch.zeros(1, 2, *frame.size)
    strata = gradient[..., 1::STRATUM, 1::STRATUM]
    strata[(slice(None), 0, *where)] = difference
    strata[(slice(None), 1, *where)] = largest
    frame.channels["gradient"] = gradient
    return frame


@pytest.mark.parametrize("motion", [(0.0, 0.0), (0.4, -0.3)])
def test_it_is_exactly_svgf_where_light_stays(motion):
    frames = chain([flat_frame(SIZE, SIZE, motion, irradiance=light) for light in noise(8)])
    torch.testing.assert_close(run(ASVGF(), frames), run(SVGF(), frames), rtol=0, atol=0)


def test_uniform_ratios_are_unchanged():
    frame = with_gradient(flat_frame(SIZE, SIZE), -0.6, 2.0)
    torch.testing.assert_close(change_of_light(frame), torch.full((1, 1, SIZE, SIZE), 0.3))
    frame = with_gradient(flat_frame(SIZE, SIZE), 5.0, 2.0)  # λ is at most 1
    assert (change_of_light(frame) == 1).all()


def test_a_change_ends_where_the_surface_does():
    mesh_id = torch.ones(1, 1, SIZE, SIZE)
    mesh_id[..., SIZE // 2 :] = 2
    frame = with_gradient(flat_frame(SIZE, SIZE, mesh_id=mesh_id), 0.0, 1.0)
    frame.channels["gradient"][:, 0, 1::STRATUM, 1 : SIZE // 2 : STRATUM] = 0.5
    frame.channels["normal"][:, :, :, SIZE // 2 :] = torch.tensor([1.0, 0.0, 0.0])[None, :, None, None]
    change = change_of_light(frame)
    torch.testing.assert_close(change[..., : SIZE // 2], torch.full((1, 1, SIZE, SIZE // 2), 0.5))
    assert (change[..., SIZE // 2 :] == 0).all()


def test_empty_strata_take_the_ratio_of_others():
    frame = with_gradient(flat_frame(SIZE, SIZE), 0.5, 1.0, (slice(2, 4), slice(3, 5)))
    torch.testing.assert_close(change_of_light(frame), torch.full((1, 1, SIZE, SIZE), 0.5))


def test_it_follows_a_light_that_jumps():
    bright = noise(6)
    dark = noise(2, 0.1, seed=1)
    frames = [flat_frame(SIZE, SIZE, irradiance=light) for light in bright + dark]
    with_gradient(frames[6], -0.9, 1.0)
    adaptive = run(ASVGF(), frames)[6].mean()
    lagging = run(SVGF(), frames)[6].mean()
    assert abs(adaptive - 0.1) < 0.25 * abs(lagging - 0.1)
    assert lagging > 0.5


def test_history_is_discarded_in_proportion():
    """The second colour is (1 - α) C' + α C with α = (1 - λ) / 2 + λ; the length shrinks by 1 - λ."""
    frames = [flat_frame(SIZE, SIZE, irradiance=torch.full((1, 3, SIZE, SIZE), level)) for level in (1.0, 3.0)]
    with_gradient(frames[1], 0.5, 2.0)
    _, state = play(ASVGF(), frames)
    assert isinstance(state, SVGFState)
    alpha = 0.75 / 2 + 0.25
    torch.testing.assert_close(state.history.moments[:, 0, 0], torch.full((1, SIZE, SIZE), (1 - alpha) + 3 * alpha))
    torch.testing.assert_close(state.history.length, torch.full((1, 1, SIZE, SIZE), 1.75))


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (4, 7), (9, 5)])
def test_strata_and_back(size):
    image = torch.arange(size[0] * size[1], dtype=torch.float32).view(1, 1, *size)
    whole = np.zeros((-(-size[0] // 3) * 3, -(-size[1] // 3) * 3), np.float32)
    whole[: size[0], : size[1]] = image[0, 0]
    expected = whole.reshape(whole.shape[0] // 3, 3, -1, 3).sum(axis=(1, 3))
    np.testing.assert_array_equal(strata_sums(image)[0, 0], expected)
    assert repeat_strata(strata_sums(image), size).shape == image.shape
    np.testing.assert_array_equal(
        repeat_strata(strata_centres(image), size)[0, 0, ::3, ::3], strata_centres(image)[0, 0]
    )
    assert strata_centres(image)[0, 0, 0, 0] == image[0, 0, min(1, size[0] - 1), min(1, size[1] - 1)]
