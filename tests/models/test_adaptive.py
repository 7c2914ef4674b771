"""Adaptive accumulation: false alarms, energy, fireflies, and changes of light."""

import pytest
import torch

import models.wrappers.adaptive
from errors import BadInput
from models import registry
from models.filters.baselines import Accumulated
from models.history.accumulation import accumulate
from models.wrappers.adaptive import (
    FIREFLY_RATIO,
    MAX_GAIN,
    AccumulatedAfter,
    SurfaceNeighbourhoods,
    accumulate_adaptively,
    firefly_limit,
    history_gain,
    spread_fireflies,
)
from models.wrappers.wrapper import unwrapped
from tests.helpers.frames import chain, flat_frame, play

SIZE = 48


def grey(light: torch.Tensor) -> torch.Tensor:
    return light.expand(1, 3, *light.shape[-2:]).contiguous()


def noisy_light(generator: torch.Generator, level: float = 1.0) -> torch.Tensor:
    """Light of mean `level` at one sample per pixel: half of the pixels black, a long tail, (1, 3, H, W)."""
    size = (1, 1, SIZE, SIZE)
    tail = torch.exp(torch.randn(size, generator=generator) - 0.5)  # of mean 1
    return grey(level * 2 * tail * (torch.rand(size, generator=generator) < 0.5))


@pytest.mark.parametrize(
    ("firefly", "every"),
    [(1e4, 50), *(pytest.param(firefly, 1, marks=pytest.mark.slow) for firefly in (0.0, 1e3))],
)
def test_noise_raises_few_false_alarms_and_loses_no_energy(monkeypatch, firefly, every):
    """A χ² of one degree of freedom exceeds 6 in 1.4 % of cases; fireflies must not add many.

    Noise has a constant mean; a firefly of that luminance is added to one pixel `every` so many frames.
    """
    gains = []

    def recorded(*arguments):
        gains.append(history_gain(*arguments))
        return gains[-1]

    monkeypatch.setattr(models.wrappers.adaptive, "history_gain", recorded)
    generator = torch.Generator().manual_seed(1)
    history = None
    outputs = []
    inputs = []
    for index in range(150):
        light = noisy_light(generator)
        if index % every == every // 2:
            light[..., (7 * index) % SIZE, (11 * index) % SIZE] += firefly
        history = accumulate_adaptively(flat_frame(SIZE, SIZE, irradiance=light), light, history)
        outputs.append(history.irradiance.mean())
        inputs.append(light.mean())
    assert 0 < torch.stack([(gain != 1).float().mean() for gain in gains[10:]]).mean() < 0.03
    # The output lags by some frames.
    assert abs(torch.stack(outputs[10:]).mean() / torch.stack(inputs[6:-4]).mean() - 1) < 0.01


def test_a_firefly_is_no_change():
    """It leaves the history unchanged."""
    generator = torch.Generator().manual_seed(0)
    even = flat_frame(SIZE, SIZE, irradiance=grey(1 + 0.1 * torch.rand(1, 1, SIZE, SIZE, generator=generator)))
    history = None
    for _ in range(6):
        history = accumulate_adaptively(even, even.direct, history)
    light = even.direct.clone()
    light[..., 20, 20] = 65504
    after = accumulate_adaptively(flat_frame(SIZE, SIZE, irradiance=light), light, history)
    mean = float(even.direct.mean())
    share = (65504 - FIREFLY_RATIO * mean) / 441 + (FIREFLY_RATIO - 1) * mean  # at its own pixel, which keeps the limit
    assert (after.irradiance - history.irradiance).abs().max() == pytest.approx(share / 5, rel=0.01)
    plain = accumulate(even, light, history)
    assert plain.irradiance.max() > 400 * after.irradiance.max() / 5


@pytest.mark.slow
def test_clamping_loses_no_energy_at_the_edges_of_surfaces():
    """In the mean of many frames, beside an edge and at the border."""
    generator = torch.Generator().manual_seed(0)
    mesh_id = torch.ones(1, 1, SIZE, SIZE)
    mesh_id[..., 20:] = 2
    mesh_id[..., 40:] = 0
    total = torch.zeros(1, 3, SIZE, SIZE)
    for _ in range(600):
        light = noisy_light(generator) * (mesh_id > 0)
        frame = flat_frame(SIZE, SIZE, mesh_id=mesh_id, irradiance=light)
        frame.channels["depth"] = 2.0 * mesh_id
        frame.channels["normal"][:, :, :, 20:] = torch.tensor([1.0, 0.0, 0.0])[None, :, None, None]
        near = SurfaceNeighbourhoods(frame)
        total += spread_fireflies(light, firefly_limit(mesh_id.clamp(max=1), near), near)
    mean = total[0, 0] / 600
    assert (mean[:, 40:] == 0).all()
    for columns in (slice(0, 3), slice(3, 17), slice(17, 20), slice(20, 23), slice(23, 37), slice(37, 40)):
        assert abs(mean[:, columns].mean() - 1) < 0.03
    assert abs(mean[:, :40].mean() - 1) < 0.01


def spread_firefly(mesh_id: torch.Tensor) -> torch.Tensor:
    """What becomes of a firefly of 1000 in the light of 1 that meshes 1 and 2 get; their normals differ."""
    light = torch.ones(1, 3, SIZE, SIZE)
    light[..., 20, 20] = 1000
    frame = flat_frame(SIZE, SIZE, mesh_id=mesh_id, irradiance=light)
    frame.channels["normal"] = torch.where(mesh_id > 1, frame.normal.roll(1, dims=1), frame.normal)
    near = SurfaceNeighbourhoods(frame)
    return spread_fireflies(light, firefly_limit(torch.ones(1, 1, SIZE, SIZE), near), near)


def test_a_firefly_is_spread_over_its_neighbourhood():
    result = spread_firefly(torch.ones(1, 1, SIZE, SIZE))
    rest = 1000 - FIREFLY_RATIO
    assert result[0, 0, 20, 20] == pytest.approx(FIREFLY_RATIO + rest / 441, rel=1e-3)  # 7 x 7 strata of 9 pixels
    assert result[0, 0, 25, 14] == pytest.approx(1 + rest / 441, rel=1e-3)
    assert result[0, 0, 40, 20] == 1


def test_no_light_crosses_to_another_mesh():
    mesh_id = torch.ones(1, 1, SIZE, SIZE)
    mesh_id[..., 23:] = 2  # within a stratum, whose middle is of mesh 1
    result = spread_firefly(mesh_id)
    assert (result[..., 23:] == 1).all() and result[0, 0, 20, 22] > 2


def both_ways(lights: list[torch.Tensor], motion: tuple[float, float] = (0.0, 0.0)):
    """The outputs and the last state of accumulation with adaptation, and those without."""
    frames = chain([flat_frame(SIZE, SIZE, motion, irradiance=light) for light in lights])
    return play(registry.create("accumulated+adaptive"), frames), play(Accumulated(), frames)


@pytest.mark.parametrize("motion, most", [((0.0, 0.0), 0.9), ((0.4, -0.3), 0.8)])
def test_the_weight_of_the_newest_frame_is_that_of_plain_accumulation(motion, most):
    """Noise too small to be clamped and too independent to be significant: the same average in most pixels."""
    generator = torch.Generator().manual_seed(0)
    lights = [grey(1 + 0.1 * torch.randn(1, 1, SIZE, SIZE, generator=generator)) for _ in range(4)]
    (outputs, state), (plain, expected) = both_ways(lights, motion)
    assert ((outputs[-1] - plain[-1]).abs().amax(dim=1) < 1e-5).float().mean() > most
    assert torch.equal(state.history.length, expected.history.length)


@pytest.mark.parametrize("factor", [0.3, 2.5])
def test_history_follows_a_light_that_jumps(factor):
    """In one frame, without more noise."""
    generator = torch.Generator().manual_seed(0)
    lights = [noisy_light(generator) for _ in range(20)] + [noisy_light(generator, factor) for _ in range(2)]
    (adaptive, _), (plain, _) = both_ways(lights)
    lagging = plain[-2]
    assert abs(lagging.mean() - factor) > 0.7 * abs(1 - factor)
    for output in adaptive[-2:]:
        assert abs(output.mean() / factor - 1) < 0.1
        assert output.std() / output.mean() < lagging.std() / lagging.mean() * 1.1


@pytest.mark.parametrize(("before", "after"), [(0.0, 1.0), (1e-3, 1.0), (1.0, 20.0), (20.0, 1.0)])
def test_history_does_not_overshoot_light_that_is_switched(before, after):
    """Limits from near darkness are far too low: light clamped at them does not measure the change."""
    generator = torch.Generator().manual_seed(0)
    lights = [noisy_light(generator, level) for level in [before] * 8 + [after] * 10]
    (adaptive, _), (plain, _) = both_ways(lights)
    assert all(abs(output.mean() / after - 1) < 0.15 for output in adaptive[10:])
    assert abs(plain[10].mean() / after - 1) > 0.4


def test_a_gain_is_bounded():
    ((_, output), _), _ = both_ways([torch.full((1, 3, SIZE, SIZE), level) for level in (1.0, 100.0)])
    torch.testing.assert_close(output, torch.full_like(output, (MAX_GAIN + 100) / 2))


def test_every_accumulating_denoiser_has_the_wrapper():
    for name in ("accumulated", "eaw", "bmfr", "sbf", "oidn-accumulated", "wskp6", "kp", "wskp-mr", "mr-kp", "nbgd"):
        adaptive = registry.prototype(f"{name}+adaptive")
        assert unwrapped(adaptive).accumulation is accumulate_adaptively
        assert adaptive.reads == registry.prototype(name).reads
        assert registry.prototype(name).accumulation is accumulate
    assert isinstance(registry.prototype("oidn+accumulated+adaptive").inner, AccumulatedAfter)
    for name in ("aaf", "eaw"):  # whose means after it have the same range
        inner, after = registry.prototype(name), registry.prototype(f"{name}+accumulated")
        assert (after.convex, after.separates_lights) == (inner.convex, inner.separates_lights)
    for name in ("noisy+adaptive", "svgf+adaptive", "eaw+taa+adaptive"):
        with pytest.raises(BadInput, match=r"which \+adaptive replaces"):
            registry.prototype(name)
