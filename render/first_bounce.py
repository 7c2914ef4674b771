"""The first bounce of the noisy samples, repeated without tracing whole paths, and distances to what its rays hit.

Axis-aligned filtering (Mehta et al. 2012, 2013) derives from them how fast light can vary along a surface.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.path import PathTracer, SampleRange
from render.sampler import Sampler, hash32
from render.stage import Stage, T
from scenes.camera import View

UNIFORM_VARIANCE = 1 / 12  # of a uniform distribution over [0, 1]


def first_bounce(
    stage: Stage, ray: mi.Ray3f, pixel: mi.UInt32, seed: mi.UInt32, index: mi.UInt32, draw: type[Sampler]
) -> tuple[mi.SurfaceInteraction3f, mi.DirectionSample3f, mi.Color3f, mi.Bool, mi.Bool, mi.BSDFSample3f]:
    """The sample number `index` of those that `sample_mean` takes for these arguments along primary rays.

    Of each ray: (the visible surface, the point on a light that next-event estimation has chosen, unoccluded radiance
    from there over the density of the choice, whether that light is infinitely far away, whether the surface reflects
    it to the camera, the direction in which the path continues). Only primary rays are traced.
    """
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    sampler = draw(hash32(hash32(pixel) ^ seed), index, mi.UInt32(1))
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


def of_sample(function: Callable[..., T], tracer: PathTracer, view: View, seed: int, index: int) -> T:
    """`function`, whose arguments are those of `first_bounce`, of a sample that `tracer.radiance` draws with `seed`.

    With the stage posed for `view`.
    """
    numbers = [dr.opaque(mi.UInt32, number) for number in (seed, index)]
    arguments = tracer.stage.rays(view), tracer.every_pixel, *numbers, tracer.draw
    return tracer.stage.replay(function, *arguments, freezes=tracer.freezes)


def hits(stage: Stage, *sample: Any) -> list[mi.Float]:
    """The four values whose means `hit_channels` returns, for one sample a pixel; 0 for misses."""
    scene = stage.mitsuba_scene
    si, light, radiance, infinite, faces, bsdf_sample = first_bounce(stage, *sample)
    continues = si.is_valid() & (bsdf_sample.pdf > 0)
    onward = si.spawn_ray(si.to_world(bsdf_sample.wo))
    hit = scene.ray_intersect(onward, mi.RayFlags.Minimal, coherent=False, active=continues)
    lit = faces & dr.any(radiance != 0)
    blocker = scene.ray_intersect(si.spawn_ray_to(light.p), mi.RayFlags.Minimal, coherent=False, active=lit)
    solid_angle = dr.select(light.delta, 0, 1 / (light.pdf * stage.lights.odds))
    return [
        dr.select(continues & hit.is_valid(), dr.norm(hit.p - si.p), 0),
        dr.select(lit & blocker.is_valid(), dr.norm(blocker.p - si.p), 0),
        dr.select(lit & ~infinite, light.dist, 0),
        dr.select(lit, dr.sqrt(UNIFORM_VARIANCE * solid_angle), 0),
    ]


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
    values = (of_sample(hits, tracer, view, seed, index) for seed, index in indices)
    samples = np.stack([np.concatenate([tracer.stage.image(each) for each in four], axis=-1) for four in values])
    means = samples.sum(axis=0, dtype=np.float64) / np.maximum((samples > 0).sum(axis=0), 1)
    means[..., :3] *= tracer.stage.unit
    return {"hit_distance": means[..., :2], "light_distance": means[..., 2:3], "light_angle": means[..., 3:]}
