"""Mitsuba's stock path integrator on our primary rays, and a test of whether two sets of images have the same mean."""

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.clip import Arrays
from render.gbuffer import render_gbuffer
from render.stage import Stage
from scenes.animation import Scene
from scenes.camera import Array, View, motion_vectors, pixel_centres
from scenes.colours import Bsdf

POSED_FRAME = 5  # where tests of radiance pose their stages
BLOCK_SIZE = 4  # px


def rgb(*value: float) -> Bsdf:
    """A colour in a Mitsuba dictionary."""
    return {"type": "rgb", "value": list(value)}


def first_gbuffer(scene: Scene, height: int, width: int) -> Arrays:
    """The G-buffer of a scene's first frame."""
    stage = Stage(scene, height, width)
    return render_gbuffer(stage, stage.view(0))


def posed_surfaces(stage: Stage, frame: int) -> tuple[View, View, Array, NDArray[np.integer], Array]:
    """Poses the stage: views of the frame and the one before, depth and mesh ids (H, W), motion vectors (H, W, 2)."""
    stage.pose(frame)
    now, previous = stage.view(frame), stage.view(frame - 1)
    buffer = render_gbuffer(stage, now)
    depth = buffer["depth"][..., 0].astype(np.float64)
    mesh_id = buffer["mesh_id"][..., 0].astype(int)
    centres = pixel_centres(stage.height, stage.width)
    return now, previous, depth, mesh_id, motion_vectors(centres, depth, mesh_id, now, previous)


def stock_images(stage: Stage, max_depth: int, count: int, spp: int = 16, seed: int = 0) -> NDArray[np.float32]:
    """Radiance (N, H, W, 3), emission included, by Mitsuba's own path tracer through our pixel-centre rays.

    `count` independent images at once, since tracing the kernel takes longer than running it. The stage must be posed
    for POSED_FRAME.
    """
    pixels = stage.height * stage.width
    sampler = mi.load_dict({"type": "independent", "sample_count": spp})
    sampler.seed(seed, count * pixels * spp)
    integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": 1000})
    ray = stage.rays(stage.view(POSED_FRAME))
    pixel = dr.arange(mi.UInt32, count * pixels * spp) // spp % pixels
    ray.o = ray.o + dr.zeros(mi.Point3f, pixels)  # one eye for all, or a point behind cut-outs for each
    ray = mi.RayDifferential3f(dr.gather(mi.Ray3f, ray, pixel))
    colour, _, _ = integrator.sample(stage.mitsuba_scene, sampler, ray)
    return np.array(colour).T.reshape(count, stage.height, stage.width, spp, 3).mean(axis=3)


def block_means(images: NDArray[np.floating]) -> NDArray[np.floating]:
    """Means (N, H / BLOCK_SIZE, W / BLOCK_SIZE) over square blocks of pixels and the colours of images (N, H, W, 3)."""
    n, height, width, _ = images.shape
    blocks = images.reshape(n, height // BLOCK_SIZE, BLOCK_SIZE, width // BLOCK_SIZE, BLOCK_SIZE, 3)
    return blocks.mean(axis=(2, 4, 5))


def assert_same_mean(ours: NDArray[np.floating], theirs: NDArray[np.floating]) -> None:
    """Blocks of pixels of many independent images (N, H, W, 3) agree: 98 % within 3 standard errors, all within 5."""
    a, b = block_means(ours), block_means(theirs)
    error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    z = np.abs(a.mean(axis=0) - b.mean(axis=0)) / np.maximum(error, 1e-6)
    assert (z < 3).mean() >= 0.98
    assert z.max() < 5
