"""The path tracer: direct and indirect radiance in one pass from shared, noise-free primary hits.

Unidirectional with next-event estimation and multiple importance sampling, as Mitsuba's `path` without Russian
roulette; but the primary ray is traced once however many samples a pixel gets, and the first bounce is kept apart.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.sampler import Sampler, hash32
from render.stage import Stage


def mis_weight(pdf: Any, other: Any) -> Any:
    """The power heuristic (Veach 1997, §9.2.4) with exponent 2."""
    return dr.select(pdf > 0, pdf**2 / (pdf**2 + other**2), 0)


def bounce(scene: Any, si: Any, throughput: Any, active: Any, sampler: Sampler) -> tuple[Any, Any, Any, Any]:
    """Radiance that comes to `si` straight from emitters, and the next vertex: (radiance, si, throughput, active)."""
    bsdf = si.bsdf()
    u_emitter, u_lobe, u_direction = sampler.next_2d(), sampler.next_1d(), sampler.next_2d()

    smooth = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    light, emitter_weight = scene.sample_emitter_direction(si, u_emitter, True, smooth)
    smooth &= light.pdf != 0
    value, bsdf_pdf, sample, bsdf_weight = bsdf.eval_pdf_sample(
        mi.BSDFContext(), si, si.to_local(light.d), u_lobe, u_direction, active
    )
    mis = dr.select(light.delta, 1, mis_weight(light.pdf, bsdf_pdf))
    radiance = dr.select(smooth, throughput * value * emitter_weight * mis, 0)

    throughput = throughput * bsdf_weight
    active = active & dr.any(throughput != 0)
    following = scene.ray_intersect(
        si.spawn_ray(si.to_world(sample.wo)), mi.RayFlags.All, coherent=False, active=active
    )
    emitter = following.emitter(scene, active)
    towards = mi.DirectionSample3f(scene, following, si)
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    emitter_pdf = scene.pdf_emitter_direction(si, towards, active & (emitter != None) & ~delta)  # noqa: E711 - traced
    mis = mis_weight(sample.pdf, emitter_pdf)
    radiance += dr.select(active, throughput * emitter.eval(following, active) * mis, 0)
    return radiance, following, throughput, active & following.is_valid()


@dr.syntax
def trace_paths(scene: Any, primary: Any, key: Any, index: Any, max_depth: Any) -> tuple[Any, Any]:
    """One sample of (direct, indirect) radiance, both mi.Color3f, leaving the hits `primary` toward the camera."""
    throughput, active = mi.Color3f(1), primary.is_valid()
    direct, si, throughput, active = bounce(scene, primary, throughput, active, Sampler(key, index))
    indirect = mi.Color3f(0)
    depth = mi.UInt32(2)
    while active & (depth < max_depth):
        sampler = Sampler(hash32(key ^ depth), index)
        radiance, si, throughput, active = bounce(scene, si, throughput, active, sampler)
        indirect += radiance
        depth += 1
    return direct, indirect


@dr.syntax
def sample_mean(scene: Any, ray: Any, seed: Any, spp: Any, max_depth: Any) -> tuple[Any, Any]:
    """Mean direct and indirect radiance of `spp` samples a ray, summed lane by lane in a fixed order.

    `seed`, `spp` and `max_depth` are opaque mi.UInt32: one kernel serves all their values.
    """
    si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    lane = dr.arange(mi.UInt32, dr.width(ray))
    # Hash the lane before it meets the seed: a sum would make the pictures of some seeds shifted copies of each other.
    key = hash32(hash32(lane) ^ seed)
    direct, indirect = mi.Color3f(0), mi.Color3f(0)
    index = mi.UInt32(0)
    while index < spp:
        sample_direct, sample_indirect = trace_paths(scene, si, key, index, max_depth)
        direct += sample_direct
        indirect += sample_indirect
        index += 1
    count = mi.Color3f(spp)
    return direct / count, indirect / count


class PathTracer:
    """Path-traces the scene on a stage, as that is posed at the time."""

    def __init__(self, stage: Stage):
        self.stage, self.pose = stage, -1

    def radiance(self, ray: Any, seed: int, spp: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(direct, indirect) radiance (H, W, 3) toward the camera along the primary `ray`s of all pixels.

        `seed` in [0, 2^32); different seeds are independent, equal seeds give equal bytes. Emission is not included.
        """
        stage = self.stage
        if self.pose != stage.poses:
            # Tracing the program in Python takes longer than running it at 1 spp: frozen, it is replayed. But a frozen
            # function does not notice all changes of meshes (seen with Dr.Jit 1.5), so it lasts as long as a pose.
            self.sample_mean, self.pose = dr.freeze(sample_mean), stage.poses
        numbers = (dr.opaque(mi.UInt32, number) for number in (seed, spp, stage.scene.max_depth))
        images = self.sample_mean(stage.mitsuba_scene, ray, *numbers)
        dr.eval(images)
        return stage.image(images[0]), stage.image(images[1])
