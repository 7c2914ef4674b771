"""The path tracer: direct and indirect radiance in one pass from shared, noise-free primary hits.

Unidirectional with next-event estimation, multiple importance sampling and Russian roulette, as Mitsuba's `path`;
but the primary ray is traced once however many samples a pixel gets, and the first bounce is kept apart.
"""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type, call-overload, operator, return-value"

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.lights import Lights
from render.palette import palette
from render.regularise import BlurredTable
from render.sampler import HaltonSampler, Sampler, hash32
from render.stage import Stage

AnySampler = Sampler | HaltonSampler
ROULETTE = 3.0  # times the throughput is the chance that a path goes on


def mis_weight(pdf: mi.Float, other: mi.Float) -> mi.Float:
    """The power heuristic (Veach 1997, §9.2.4) with exponent 2."""
    return dr.select(pdf > 0, pdf**2 / (pdf**2 + other**2), 0)


def bounce(
    scene: mi.Scene,
    lights: Lights,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    throughput: mi.Color3f,
    last: mi.Bool,
    sampler: AnySampler,
) -> tuple[mi.Color3f, mi.SurfaceInteraction3f, mi.Color3f, mi.Bool]:
    """(radiance, si, throughput, active): light that reaches `si` straight from emitters, and the path's next vertex.

    Both strategies of multiple importance sampling count: a point on an emitter, and the direction that goes on. But a
    path's `last` ray, if it leaves a diffuse surface, is not traced: all it could find are emitters, whose points are
    the better choice there.
    """
    u_emitter = sampler.next_2d()
    u_lobe = sampler.next_1d()
    u_direction = sampler.next_2d()

    smooth = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    light, emitter_weight = lights.sample_direction(si, u_emitter, smooth)
    value, bsdf_pdf, sample, bsdf_weight = bsdf.eval_pdf_sample(
        mi.BSDFContext(), si, si.to_local(light.d), u_lobe, u_direction
    )
    ends = last & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Glossy) & ~mi.has_flag(bsdf.flags(), mi.BSDFFlags.Delta)
    mis = dr.select(light.delta | ends, 1, mis_weight(light.pdf, bsdf_pdf))
    radiance = throughput * value * emitter_weight * mis
    lit = smooth & (light.pdf != 0) & dr.any(radiance != 0)  # shadow rays only for light that would count
    radiance = dr.select(lit & ~scene.ray_test(si.spawn_ray_to(light.p), lit), radiance, 0)

    throughput = throughput * bsdf_weight
    active = dr.any(throughput != 0) & ~ends
    following = scene.ray_intersect(si.spawn_ray(si.to_world(sample.wo)), active)
    emitter = lights.at(following)
    towards = mi.DirectionSample3f(None, following, si)  # with the scene it would compile in which light the sky is
    towards.emitter = emitter
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    emitter_pdf = lights.pdf_direction(si, towards, active & (emitter != None) & ~delta)  # noqa: E711 - traced
    mis = mis_weight(sample.pdf, emitter_pdf)
    radiance += dr.select(active, throughput * emitter.eval(following, active) * mis, 0)
    return radiance, following, throughput, active & following.is_valid()


def survive(throughput: mi.Color3f, depth: mi.UInt32, active: mi.Bool, u: mi.Float) -> tuple[mi.Color3f, mi.Bool]:
    """Russian roulette from the second bounce on: (throughput, active) after most dim paths have ended.

    `u` in [0, 1) decides.
    """
    chance = dr.select(depth > 1, dr.clip(ROULETTE * dr.max(throughput), 0.05, 1), 1)
    return throughput / chance, active & (u < chance)


@dr.syntax
def sample_mean(
    scene: mi.Scene,
    lights: Lights,
    ray: mi.Ray3f,
    pixel: mi.UInt32,
    seed: mi.UInt32,
    first: mi.UInt32,
    spp: mi.UInt32,
    max_depth: mi.UInt32,
    draw: type[AnySampler],
    blurred: BlurredTable | None,
) -> tuple[mi.Color3f, mi.Color3f]:
    """Mean direct and indirect radiance of `spp` samples a ray, summed lane by lane in a fixed order.

    Each ray draws the random numbers of its `pixel`, counted row by row. `seed`, `first` (the index of the first
    sample), `spp` and `max_depth` are opaque, so one kernel serves all their values. A lane whose path has ended goes
    on with its next sample at once, so that short paths leave no lane idle. `draw` is the sampler; `blurred`
    regularises (see PathTracer).
    """
    primary = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    # Hash the pixel before it meets the seed: a sum would make the pictures of some seeds shifted copies of each other.
    key = hash32(hash32(pixel) ^ seed)
    direct = mi.Color3f(0)
    indirect = mi.Color3f(0)
    si = dr.copy(primary)
    throughput = mi.Color3f(1)
    depth = mi.UInt32(1)
    index = mi.UInt32(0)
    while primary.is_valid() & (index < spp):
        sampler = draw(key, first + index, depth)
        bsdf = si.bsdf() if blurred is None else blurred.after_first(si, depth)
        radiance, si, throughput, active = bounce(scene, lights, si, bsdf, throughput, depth + 1 == max_depth, sampler)
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


def all_objects(*_: object, **__: object) -> list[object]:
    """What Dr.Jit must know of beside the arguments of a frozen function: objects that kernels might call."""
    return palette()


class Draw(NamedTuple):
    """Which samples of every pixel are drawn."""

    seed: int  # in [0, 2^32): different ones are independent
    spp: int  # how many
    first: int = 0  # index of the first, where they follow a sequence


class PathTracer:
    """Path-traces the scene on a stage as the stage is posed at the time.

    halton: draw from a cycle of 16 Halton points (see HaltonSampler); `radiance` starts at the point `first`.
    regularise: blur glossy materials from the second vertex of a path on (see BlurredTable). Biased, less noisy.
    """

    def __init__(self, stage: Stage, halton: bool = False, regularise: bool = False):
        self.stage = stage
        self.every_pixel = dr.arange(mi.UInt32, stage.height * stage.width)
        dr.make_opaque(self.every_pixel)
        self.frozen_pose = -1  # stage.poses when `sample_mean` was frozen
        self.draw: type[AnySampler] = HaltonSampler if halton else Sampler
        self.blurred = BlurredTable(stage) if regularise else None
        # Dr.Jit 1.5 refuses to freeze the rest: Halton points, regularised paths, surfaces that shine by a picture, and
        # scenes without shapes (these only while another scene is loaded).
        self.freezes = bool(stage.shapes) and not halton and not regularise and not stage.has_pictured_lights

    def samples(
        self, ray: mi.Ray3f, pixel: mi.UInt32, seed: int, spp: int, first: int = 0
    ) -> tuple[mi.Color3f, mi.Color3f]:
        """(direct, indirect) radiance along the primary rays `ray`, which need not be those of all pixels.

        Each draws the random numbers of the `pixel`, counted row by row. For the rest see `radiance`.
        """
        stage = self.stage
        if self.frozen_pose != stage.poses:
            # Tracing the program in Python takes longer than running it at 1 spp: frozen, it is replayed. But a frozen
            # function does not notice all changes of meshes (seen with Dr.Jit 1.5), so it lasts as long as a pose.
            self.sample_mean = dr.freeze(sample_mean, state_fn=all_objects) if self.freezes else sample_mean
            self.frozen_pose = stage.poses
        direct, indirect = self.sample_mean(
            stage.mitsuba_scene,
            stage.lights,
            ray,
            pixel,
            seed=dr.opaque(mi.UInt32, seed),
            first=dr.opaque(mi.UInt32, first),
            spp=dr.opaque(mi.UInt32, spp),
            max_depth=dr.opaque(mi.UInt32, stage.scene.max_depth),
            draw=self.draw,
            blurred=self.blurred,
        )
        dr.eval(direct, indirect)
        return direct, indirect

    def radiance(
        self, ray: mi.Ray3f, seed: int, spp: int, first: int = 0
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(direct, indirect) radiance (H, W, 3) toward the camera along the primary rays `ray` of all pixels.

        `seed` in [0, 2^32): different seeds are independent, equal seeds give equal bytes. Emission is not included.
        """
        direct, indirect = self.samples(ray, self.every_pixel, seed, spp, first)
        return self.stage.image(direct), self.stage.image(indirect)
