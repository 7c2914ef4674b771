"""The path tracer against Mitsuba's stock `path` integrator on the same primary rays."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from render.gbuffer import render_gbuffer
from render.path import PathTracer
from render.stage import Stage
from scenes.animation import Camera, RigidMotion, Scene, Shape, Track
from scenes.cornell import repaint
from scenes.registry import build_scene
from tests.helpers.rendering import POSED_FRAME, assert_same_mean, stock_images


def realisations(stage: Stage, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Emission (H, W, 3), direct and indirect radiance (N, H, W, 3) of one sample a pixel, with seeds 0 to N - 1."""
    stage.pose(POSED_FRAME)
    emission = render_gbuffer(stage, stage.view(POSED_FRAME))["emission"]
    ray = stage.rays(stage.view(POSED_FRAME))
    tracer = PathTracer(stage)
    images = [tracer.radiance(ray, seed, spp=1) for seed in range(count)]
    return emission, np.stack([direct for direct, _ in images]), np.stack([indirect for _, indirect in images])


def everything(stage: Stage, frame: int) -> dict[str, np.ndarray]:
    """The G-buffer and sampled light of a frame, by channel and seed."""
    stage.pose(frame)
    view = stage.view(frame)
    ray = stage.rays(view)
    light = {f"light {seed}": np.stack(PathTracer(stage).radiance(ray, seed, 4)) for seed in (1, 2)}
    return render_gbuffer(stage, view) | light


@pytest.fixture(scope="module")
def small(stage: Stage) -> Stage:
    """Posed for POSED_FRAME."""
    small = Stage(stage.scene, 32, 32)
    small.pose(POSED_FRAME)
    return small


@pytest.fixture(scope="module")
def sampled(small: Stage) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return realisations(small, 600)


@pytest.fixture(scope="module")
def stock(small: Stage) -> np.ndarray:
    """All light by the stock integrator, radiance (N, H, W, 3)."""
    return stock_images(small, 3, 30)


def test_one_spp_images_average_to_the_stock_integrator(small, sampled, stock):
    emission, direct, indirect = sampled
    np.testing.assert_allclose(emission, stock_images(small, 1, 1, spp=1)[0], atol=1e-6)
    assert_same_mean(emission + direct, stock_images(small, 2, 30))
    assert_same_mean(emission + direct + indirect, stock)


def test_rarely_sampled_lights_have_the_same_mean_and_more_noise(small, sampled, stock):
    emission, *light = sampled
    small.lights.sample_rarely(6)
    try:
        _, *rare = realisations(small, 600)
    finally:
        small.lights.sample_rarely(1)
    assert_same_mean(emission + sum(rare), stock)
    for often, rarely in zip(light, rare, strict=True):
        assert rarely.var(axis=0).mean() > 2 * often.var(axis=0).mean()


@pytest.mark.slow
def test_metal_plastic_and_sky_average_to_the_stock_integrator():
    """Long paths with Russian roulette over glossy materials, lit by a lamp and through the open front by the sky."""
    metal = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
    coated = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}}
    paint = {"short-block": metal, "tall-block": coated}
    scene = repaint(build_scene("cornell_box", 3, 24), lambda shape: paint.get(shape.name, shape.bsdf))
    sky = np.linspace(0.5, 2, 4 * 8 * 3).reshape(4, 8, 3)
    stage = Stage(replace(scene, sky=sky, max_depth=6), 64, 64)
    emission, direct, indirect = realisations(stage, 600)
    assert_same_mean(emission + direct + indirect, stock_images(stage, 6, 60))


@pytest.mark.parametrize(
    ("scene", "frames"),
    [
        ("cornell_box_moving", (4, 20, 4, 12)),
        pytest.param("glass-vitrine-moving", (0, 2, 1, 3), marks=pytest.mark.slow),
    ],
)
def test_recordings_follow_the_scene(scene, frames):
    """Every pose has the bytes that it has without recordings, and had before, whichever poses came between."""
    stages = [Stage(build_scene(scene, 5, 24), 32, 32) for _ in range(2)]
    stages[1].freezes = False
    known: dict[int, dict[str, np.ndarray]] = {}
    for frame in frames:
        for found in (everything(stage, frame) for stage in stages):
            expected = known.setdefault(frame, found)
            assert found.keys() == expected.keys()
            for name, image in found.items():
                assert image.tobytes() == expected[name].tobytes(), (frame, name)


def test_a_scene_without_shapes_is_rendered_beside_another(stage):
    assert stage.shapes  # Dr.Jit refuses to freeze calls of materials that only other scenes have
    stage = Stage(build_scene("extremes-sky", 5, 1), 8, 8)
    direct, indirect = PathTracer(stage).radiance(stage.rays(stage.view(0)), 1, 2)
    assert not direct.any() and not indirect.any()  # all that is visible of the sky is emission


def test_equal_seeds_equal_bytes_and_different_seeds_uncorrelated_noise(stage, rays):
    tracer = PathTracer(stage)
    images = [np.add(*tracer.radiance(rays, seed, spp=1)) for seed in range(8)]
    assert images[7].tobytes() == np.add(*tracer.radiance(rays, 7, spp=1)).tobytes()
    mean = np.add(*tracer.radiance(rays, 1000, spp=1024))
    noise = np.stack([((image - mean) / (mean + 0.01)).mean(axis=-1) for image in images])
    pairs = 28

    def mean_correlation(shift: int) -> float:
        shifted = np.roll(noise, shift, axis=2)
        correlation = np.corrcoef(*(images[:, :, shift:].reshape(8, -1) for images in (noise, shifted)))
        return float(np.abs(correlation[:8, 8:][np.triu_indices(8, 1)].mean()))

    # Independent images correlate by 1 / sqrt(pixels); neither alike nor shifted copies of each other.
    for shift in range(6):
        assert mean_correlation(shift) < 5 / np.sqrt(pairs * mean[..., 0].size)


def test_direct_light_on_a_square_in_closed_form():
    """Irradiance of a small lamp straight above a wide diffuse floor: radiance = albedo / pi * E."""

    def quad(half: float, up: bool) -> trimesh.Trimesh:
        faces = [[0, 2, 1], [0, 3, 2]] if up else [[0, 1, 2], [0, 2, 3]]
        corners = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1.0]]) * half
        return trimesh.Trimesh(corners, faces, process=False)

    albedo, radiance, half, distance = 0.5, 7.0, 0.01, 2.0
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [albedo] * 3}}
    above = RigidMotion(Track.constant([0.0, distance, 0]), Track.constant(0.0))
    lamp = Shape("lamp", quad(half, up=False), grey, Track.constant([radiance] * 3), above)
    camera = Camera(Track.constant([1e-3, 1.0, 0]), Track.constant([0.0, 0, 0]), Track.constant(1.0))
    stage = Stage(Scene((Shape("floor", quad(5, up=True), grey), lamp), camera), 8, 8)
    direct, indirect = PathTracer(stage).radiance(stage.rays(stage.view(0)), 0, spp=256)
    expected = albedo / np.pi * radiance * (2 * half) ** 2 / distance**2
    np.testing.assert_allclose(direct, expected, rtol=2e-3)
    assert indirect.max() < 1e-3 * expected


@pytest.mark.slow
def test_no_bias_over_many_seeds(stage, rays):
    """The whole-image mean of 20 000 one-spp images is within 4 standard errors of 65 536 stock samples a pixel."""
    tracer = PathTracer(stage)
    ours = np.array([np.add(*tracer.radiance(rays, seed, spp=1)).mean() for seed in range(20000)])
    emission = render_gbuffer(stage, stage.view(POSED_FRAME))["emission"].mean()
    theirs = np.array([stock_images(stage, 3, 1, 64, seed).mean() for seed in range(1024)]) - emission
    error = np.sqrt(ours.var() / len(ours) + theirs.var() / len(theirs))
    assert abs(ours.mean() - theirs.mean()) < 4 * error
