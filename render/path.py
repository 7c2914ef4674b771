"""The path tracer: direct and indirect radiance in one pass from shared, noise-free primary hits.

Unidirectional with next-event estimation, multiple importance sampling and Russian roulette, as Mitsuba's `path`;
but the primary ray is traced once however many samples a pixel gets, and the first bounce is kept apart.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.regularise import BlurredTable
from render.sampler import Halton, Sampler, hash32
from render.stage import Stage

ROULETTE = 3.0  # times the throughput is the chance that a path goes on


def mis_weight(pdf: Any, other: Any) -> Any:
    """The power heuristic (Veach 1997, §9.2.4) with exponent 2."""
    return dr.select(pdf > 0, pdf**2 / (pdf**2 + other**2), 0)


def bounce(scene: Any, si: Any, bsdf: Any, throughput: Any, sampler: Sampler | Halton) -> tuple[Any, Any, Any, Any]:
    """Radiance that comes to `si` straight from emitters, and the next vertex: (radiance, si, throughput, active)."""
    u_emitter, u_lobe, u_direction = sampler.next_2d(), sampler.next_1d(), sampler.next_2d()

    smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    light, emitter_weight = scene.sample_emitter_direction(si, u_emitter, False, smooth)
    value, bsdf_pdf, sample, bsdf_weight = bsdf.eval_pdf_sample(
        mi.BSDFContext(), si, si.to_local(light.d), u_lobe, u_direction
    )
    mis = dr.select(light.delta, 1, mis_weight(light.pdf, bsdf_pdf))
    radiance = throughput * value * emitter_weight * mis
    lit = smooth & (light.pdf != 0) & dr.any(radiance != 0)  # shadow rays only for light that would count
    radiance = dr.select(lit & ~scene.ray_test(si.spawn_ray_to(light.p), lit), radiance, 0)

    throughput = throughput * bsdf_weight
    active = dr.any(throughput != 0)
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


def survive(throughput: Any, depth: Any, active: Any, u: Any) -> tuple[Any, Any]:
    """Russian roulette from the second bounce on: (throughput, active) with dim paths mostly ended."""
    chance = dr.select(depth > 1, dr.clip(ROULETTE * dr.max(throughput), 0.05, 1), 1)
    return throughput / chance, active & (u < chance)


@dr.syntax
def sample_mean(
    scene: Any, ray: Any, seed: Any, first: Any, spp: Any, max_depth: Any, draw: type, blurred: BlurredTable | None
) -> tuple[Any, Any]:
    """Mean direct and indirect radiance of `spp` samples a ray, summed lane by lane in a fixed order.

    `seed`, `first` (sample), `spp` and `max_depth` are opaque mi.UInt32: one kernel serves all their values. A lane
    whose path has ended goes on with its next sample at once, so that short paths leave no lane idle. `draw` is the
    sampler; `blurred` regularises (see PathTracer).
    """
    primary = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    lane = dr.arange(mi.UInt32, dr.width(ray))
    # Hash the lane before it meets the seed: a sum would make the pictures of some seeds shifted copies of each other.
    key = hash32(hash32(lane) ^ seed)
    direct, indirect = mi.Color3f(0), mi.Color3f(0)
    si, throughput, depth, index = dr.copy(primary), mi.Color3f(1), mi.UInt32(1), mi.UInt32(0)
    while primary.is_valid() & (index < spp):
        sampler = draw(key, first + index, depth)
        bsdf = si.bsdf() if blurred is None else blurred.after_first(si, depth)
        radiance, si, throughput, active = bounce(scene, si, bsdf, throughput, sampler)
        direct += dr.select(depth == 1, radiance, 0)
        indirect += dr.select(depth == 1, 0, radiance)
        throughput, active = survive(throughput, depth, active, sampler.next_1d())
        depth += 1
        ended = ~active | (depth >= max_depth)
        si = dr.select(ended, primary, si)
        throughput = dr.select(ended, 1, throughput)
        depth = dr.select(ended, 1, depth)
        index += dr.select(ended, 1, 0)
    count = mi.Color3f(spp)
    return direct / count, indirect / count


class PathTracer:
    """Path-traces the scene on a stage, as that is posed at the time.

    halton: draw from a cycle of 16 Halton points (see Halton), of which `radiance` starts at its argument `first`.
    regularise: blur glossy materials from the second vertex of a path on (see BlurredTable). Biased, less noisy.
    """

    def __init__(self, stage: Stage, halton: bool = False, regularise: bool = False):
        self.stage, self.pose = stage, -1
        self.draw = Halton if halton else Sampler
        self.blurred = BlurredTable(stage) if regularise else None
        self.freezes = not halton and not regularise  # Dr.Jit 1.5 refuses to freeze these

    def radiance(
        self, ray: Any, seed: int, spp: int, first: int = 0
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(direct, indirect) radiance (H, W, 3) toward the camera along the primary `ray`s of all pixels.

        `seed` in [0, 2^32); different seeds are independent, equal seeds give equal bytes. Emission is not included.
        """
        stage = self.stage
        if self.pose != stage.poses:
            # Tracing the program in Python takes longer than running it at 1 spp: frozen, it is replayed. But a frozen
            # function does not notice all changes of meshes (seen with Dr.Jit 1.5), so it lasts as long as a pose.
            self.sample_mean, self.pose = dr.freeze(sample_mean) if self.freezes else sample_mean, stage.poses
        a, b, c, d = (dr.opaque(mi.UInt32, number) for number in (seed, first, spp, stage.scene.max_depth))
        images = self.sample_mean(stage.mitsuba_scene, ray, a, b, c, d, self.draw, self.blurred)
        dr.eval(images)
        return stage.image(images[0]), stage.image(images[1])
