"""The path tracer against Mitsuba's stock `path` integrator on the same primary rays."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from render.backend import dr, mi
from render.gbuffer import render_gbuffer
from render.path import PathTracer
from render.stage import Stage
from scenes.animation import Camera, RigidMotion, Scene, Shape, Track
from scenes.extremes import repaint
from scenes.registry import build_scene

BLOCK = 4  # px
FRAME = 5


def stock(stage: Stage, max_depth: int, spp: int, seed: int) -> np.ndarray:
    """Mean radiance (H, W, 3) of Mitsuba's own path tracer through our pixel-centre rays."""
    count = stage.height * stage.width
    sampler = mi.load_dict({"type": "independent", "sample_count": spp})
    sampler.seed(seed, count * spp)
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 1000})
    ray = stage.rays(stage.view(FRAME))
    pixel = dr.arange(mi.UInt32, count * spp) // spp
    ray = mi.RayDifferential3f(mi.Ray3f(ray.o, dr.gather(mi.Vector3f, ray.d, pixel)))
    colour, _, _ = integrator.sample(stage.mitsuba_scene, sampler, ray)
    return np.array(colour).T.reshape(stage.height, stage.width, spp, 3).mean(axis=2)


def block_means(images: np.ndarray) -> np.ndarray:
    n, height, width, _ = images.shape
    return images.reshape(n, height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3).mean(axis=(2, 4, 5))


def assert_same_mean(ours: np.ndarray, theirs: np.ndarray) -> None:
    """Blocks of pixels of many independent images (N, H, W, 3) agree: 98 % within 3 standard errors, all within 5."""
    a, b = block_means(ours), block_means(theirs)
    error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    z = np.abs(a.mean(axis=0) - b.mean(axis=0)) / np.maximum(error, 1e-9)
    assert (z < 3).mean() >= 0.98  # the three colours of a block go together
    assert z.max() < 5


def realisations(stage: Stage, count: int, first_seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    ray, radiance = stage.rays(stage.view(FRAME)), PathTracer(stage).radiance
    images = [radiance(ray, first_seed + i, spp=1) for i in range(count)]
    return np.stack([direct for direct, _ in images]), np.stack([indirect for _, indirect in images])


def test_one_spp_images_average_to_the_stock_integrator(stage):
    stage.pose(FRAME)
    direct, indirect = realisations(stage, 1200)
    emission = render_gbuffer(stage, stage.view(FRAME))["emission"]
    np.testing.assert_allclose(emission, stock(stage, 1, 1, 0), atol=1e-6)
    assert_same_mean(emission + direct, np.stack([stock(stage, 2, 16, s) for s in range(60)]))
    assert_same_mean(emission + direct + indirect, np.stack([stock(stage, 3, 16, s) for s in range(60)]))


def test_reference_averages_to_the_stock_integrator(stage):
    """Many samples of one seed are stratified, not biased."""
    stage.pose(FRAME)
    ray, radiance = stage.rays(stage.view(FRAME)), PathTracer(stage).radiance
    images = [np.add(*radiance(ray, seed, spp=32)) for seed in range(12)]
    emission = render_gbuffer(stage, stage.view(FRAME))["emission"]
    assert_same_mean(emission + np.stack(images), np.stack([stock(stage, 3, 16, 100 + s) for s in range(40)]))


def test_a_scene_may_ask_for_more_bounces():
    scene = replace(build_scene("cornell_box", 3, 24), max_depth=5)
    stage = Stage(scene, 64, 64)
    stage.pose(FRAME)
    direct, indirect = realisations(stage, 250)
    emission = render_gbuffer(stage, stage.view(FRAME))["emission"]
    assert_same_mean(emission + direct + indirect, np.stack([stock(stage, 5, 16, s) for s in range(30)]))


def test_metal_plastic_and_sky_average_to_the_stock_integrator():
    """Long paths with Russian roulette over glossy materials, lit by a lamp and through the open front by the sky."""
    metal = {"type": "roughconductor", "material": "Au", "alpha": 0.2}
    coated = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}}
    paint = {"short-block": metal, "tall-block": coated}
    scene = repaint(build_scene("cornell_box", 3, 24), lambda shape: paint.get(shape.name, shape.bsdf))
    sky = np.linspace(0.5, 2, 4 * 8 * 3).reshape(4, 8, 3)
    stage = Stage(replace(scene, sky=sky, max_depth=6), 64, 64)
    stage.pose(FRAME)
    direct, indirect = realisations(stage, 600)
    emission = render_gbuffer(stage, stage.view(FRAME))["emission"]
    assert_same_mean(emission + direct + indirect, np.stack([stock(stage, 6, 16, s) for s in range(60)]))


def test_a_replayed_kernel_follows_the_scene(moving):
    """After other frames were rendered, a frame has the bytes that it has when it is the first one."""
    tracer, images = PathTracer(moving), {}
    for frame in (4, 20, 4):
        moving.pose(frame)
        ray = moving.rays(moving.view(frame))
        images[frame] = np.stack([tracer.radiance(ray, seed, 4) for seed in (1, 2)])
    for frame in (20, 4):
        moving.pose(frame)
        ray = moving.rays(moving.view(frame))
        fresh = np.stack([PathTracer(moving).radiance(ray, seed, 4) for seed in (1, 2)])
        assert images[frame].tobytes() == fresh.tobytes()


def test_equal_seeds_equal_bytes_and_different_seeds_uncorrelated_noise(stage):
    stage.pose(FRAME)
    ray, radiance = stage.rays(stage.view(FRAME)), PathTracer(stage).radiance
    images = [np.add(*radiance(ray, seed, spp=1)) for seed in range(8)]
    again = np.add(*radiance(ray, 7, spp=1))
    assert images[7].tobytes() == again.tobytes()
    mean = np.add(*radiance(ray, 1000, spp=1024))
    noise = np.stack([((image - mean) / (mean + 0.01)).mean(axis=-1) for image in images])
    pairs = 28

    def mean_correlation(shift: int) -> float:
        correlation = np.corrcoef(
            noise[:, :, shift:].reshape(8, -1), np.roll(noise, shift, axis=2)[:, :, shift:].reshape(8, -1)
        )
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
def test_no_bias_over_many_seeds(stage):
    """The whole-image mean of 20 000 one-spp images is within 4 standard errors of 65 536 stock samples a pixel."""
    stage.pose(FRAME)
    ray, radiance = stage.rays(stage.view(FRAME)), PathTracer(stage).radiance
    ours = np.array([np.add(*radiance(ray, seed, spp=1)).mean() for seed in range(20000)])
    emission = render_gbuffer(stage, stage.view(FRAME))["emission"].mean()
    theirs = np.array([stock(stage, 3, 64, seed).mean() for seed in range(1024)]) - emission
    error = np.sqrt(ours.var() / len(ours) + theirs.var() / len(theirs))
    assert abs(ours.mean() - theirs.mean()) < 4 * error
