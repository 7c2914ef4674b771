"""The first bounce of the noisy samples, repeated without tracing whole paths, and distances to what its rays hit.

Axis-aligned filtering (Mehta et al. 2012, 2013) derives from them how fast light can vary along a surface.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.path import PathTracer, SampleRange
from render.sampler import hash32
from scenes.camera import View

UNIFORM_VARIANCE = 1 / 12  # of a uniform distribution over [0, 1]


def first_bounce(
    tracer: PathTracer, view: View, seed: int, index: int
) -> tuple[mi.SurfaceInteraction3f, mi.DirectionSample3f, mi.Color3f, mi.Bool, mi.Bool, mi.BSDFSample3f]:
    """The sample number `index` of those that `tracer.radiance` draws with `seed`, with the stage posed for `view`.

    Of each pixel: (the visible surface, the point on a light that next-event estimation has chosen, unoccluded radiance
    from there over the density of the choice, whether that light is infinitely far away, whether the surface reflects
    it to the camera, the direction in which the path continues). Only primary rays are traced.
    """
    stage = tracer.stage
    si = stage.mitsuba_scene.ray_intersect(stage.rays(view), mi.RayFlags.All, coherent=True)
    key = hash32(hash32(tracer.every_pixel) ^ dr.opaque(mi.UInt32, seed))
    sampler = tracer.draw(key, dr.opaque(mi.UInt32, index), mi.UInt32(1))
    u_emitter = sampler.next_2d()
    u_lobe = sampler.next_1d()
    u_direction = sampler.next_2d()

    bsdf = si.bsdf()
    smooth = si.is_valid() & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    light, radiance = stage.lights.sample_direction(si, u_emitter, smooth)
    infinite = mi.has_flag(light.emitter.flags(), mi.EmitterFlags.Infinite)
    faces = smooth & (light.pdf != 0) & (si.to_local(light.d).z * si.wi.z > 0)
    sample, _ = bsdf.sample(mi.BSDFContext(), si, u_lobe, u_direction, si.is_valid())
    return si, light, radiance, infinite, faces, sample


def hits_of_sample(tracer: PathTracer, view: View, seed: int, index: int) -> NDArray[np.float64]:
    """The values (H, W, 4) whose means `hit_channels` returns, for one sample a pixel; 0 for misses."""
    stage = tracer.stage
    scene = stage.mitsuba_scene
    si, light, radiance, infinite, faces, sample = first_bounce(tracer, view, seed, index)
    continues = si.is_valid() & (sample.pdf > 0)
    onward = si.spawn_ray(si.to_world(sample.wo))
    hit = scene.ray_intersect(onward, mi.RayFlags.Minimal, coherent=False, active=continues)
    lit = faces & dr.any(radiance != 0)
    blocker = scene.ray_intersect(si.spawn_ray_to(light.p), mi.RayFlags.Minimal, coherent=False, active=lit)
    solid_angle = dr.select(light.delta, 0, 1 / (light.pdf * stage.lights.odds))
    values: list[Any] = [
        dr.select(continues & hit.is_valid(), dr.norm(hit.p - si.p), 0),
        dr.select(lit & blocker.is_valid(), dr.norm(blocker.p - si.p), 0),
        dr.select(lit & ~infinite, light.dist, 0),
        dr.select(lit, dr.sqrt(UNIFORM_VARIANCE * solid_angle), 0),
    ]
    dr.eval(values)
    return np.concatenate([stage.image(value) for value in values], axis=-1).astype(np.float64)


def hit_channels(tracer: PathTracer, view: View, draws: Sequence[SampleRange]) -> dict[str, NDArray[np.float64]]:
    """Distances (H, W, C) over the samples that `tracer.radiance` takes in all `draws`, for a stage posed for `view`.

    In world units, means over the samples that hit something, 0 where none did.

    hit_distance: from the surface to the path's next vertex, and to the blocker of the shadow ray. light_distance: from
    the surface to the sampled point on a light, occluded or not; 0 for infinitely distant light. light_angle: that
    light's extent, the standard deviation of directions to it along an axis in radians: of a square whose solid angle
    is 1 over the density of the direction. So an area light counts with its projected area, a sky only with its bright
    part; 0 for point lights.
    """
    indices = ((seed, first + i) for seed, spp, first in draws for i in range(spp))
    samples = np.stack([hits_of_sample(tracer, view, seed, index) for seed, index in indices])
    means = samples.sum(axis=0) / np.maximum((samples > 0).sum(axis=0), 1)
    means[..., :3] *= tracer.stage.unit
    return {"hit_distance": means[..., :2], "light_distance": means[..., 2:3], "light_angle": means[..., 3:]}
