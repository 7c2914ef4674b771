"""The path tracer: direct and indirect radiance in one pass from shared, noise-free primary hits.

Unidirectional with next-event estimation, multiple importance sampling and Russian roulette, as Mitsuba's `path`; but
the primary ray is traced once for all samples of a pixel, and direct light is returned separately.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.gbuffer import render_gbuffer
from render.materials import is_in
from render.regularise import BlurredTable
from render.sampler import HaltonSampler, Sampler, hash32
from render.stage import Stage

ROULETTE = 3.0  # survival probability over throughput


def mis_weight(pdf: mi.Float, other: mi.Float) -> mi.Float:
    """The power heuristic (Veach 1997, §9.2.4) with exponent 2."""
    return dr.select(pdf > 0, pdf**2 / (pdf**2 + other**2), 0)


def bounce(
    stage: Stage,
    si: mi.SurfaceInteraction3f,
    bsdf: mi.BSDFPtr,
    throughput: mi.Color3f,
    last: mi.Bool,
    chain: mi.Bool,
    sampler: Sampler,
) -> tuple[mi.Color3f, mi.SurfaceInteraction3f, mi.Color3f, mi.Bool, mi.Bool, mi.UInt32]:
    """(radiance, si, throughput, active, chain, lobe): direct light reflected at `si`, and the path's next vertex.

    Emitter and BSDF sampling are combined. But a path's `last` ray is not traced from a diffuse surface, where emitter
    sampling alone is the better choice. Light at the end of a `chain` of specular events is left out: it is emission.
    `lobe` are the flags of the BSDF's lobe that the path takes.
    """
    scene, lights = stage.mitsuba_scene, stage.lights
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
    lit = smooth & (light.pdf != 0) & dr.any(radiance != 0)  # no shadow ray without contribution
    radiance = dr.select(lit & ~scene.ray_test(si.spawn_ray_to(light.p), lit), radiance, 0)

    throughput = throughput * bsdf_weight
    active = dr.any(throughput != 0) & ~ends
    following = scene.ray_intersect(si.spawn_ray(si.to_world(sample.wo)), active)
    emitter = lights.at(following)
    towards = mi.DirectionSample3f(None, following, si)  # with the scene it would compile in the index of the sky
    towards.emitter = emitter
    delta = mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta)
    chain &= delta & is_in(stage.specular, bsdf, chain)
    competes = active & (emitter != None) & ~delta  # noqa: E711 - traced
    emitter_pdf = emitter.pdf_direction(si, towards, competes) / lights.odds
    mis = mis_weight(sample.pdf, emitter_pdf)
    radiance += dr.select(active & ~chain, throughput * emitter.eval(following, active) * mis, 0)
    return radiance, following, throughput, active & following.is_valid(), chain, sample.sampled_type


@dr.syntax
def sample_mean(
    stage: Stage,
    ray: mi.Ray3f,
    pixel: mi.UInt32,
    seed: mi.UInt32,
    first: mi.UInt32,
    spp: mi.UInt32,
    max_depth: mi.UInt32,
    max_events: mi.UInt32,
    draw: type[Sampler],
    blurred: BlurredTable | None,
    splits_paths: bool,
) -> tuple[mi.Color3f, mi.Color3f, mi.Color3f, mi.Float]:
    """Mean direct and indirect radiance of `spp` samples a ray, summed lane by lane in a fixed order.

    Also the part of that radiance by paths that the first smooth glass on a chain of specular events reflects, and the
    share of such paths in the samples; 0 unless glass `splits_paths`.

    Each ray draws the random numbers of its `pixel` (row-major). `seed`, `first` (the index of the first sample), `spp`
    and `max_depth` are opaque, so one kernel serves all their values. A lane whose path has ended continues with its
    next sample at once. `draw` is the sampler; `blurred` regularises (see PathTracer). Light at the end of chains of up
    to `max_events` specular events is left out.
    """
    glass = stage.glass if splits_paths else None
    primary = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    # Hash the pixel before combining it with the seed: a sum would make images of some seeds shifted copies.
    key = hash32(hash32(pixel) ^ seed)
    direct = mi.Color3f(0)
    indirect = mi.Color3f(0)
    si = dr.copy(primary)
    throughput = mi.Color3f(1)
    depth = mi.UInt32(1)
    chain = mi.Bool(True)
    whole = mi.Bool(True)  # whether no glass has split the path
    mirrored = mi.Bool(False)  # whether glass has reflected it
    reflected = mi.Color3f(0)
    reflections = mi.UInt32(0)
    index = mi.UInt32(0)
    while primary.is_valid() & (index < spp):
        sampler = draw(key, first + index, depth)
        bsdf = si.bsdf() if blurred is None else blurred.after_first(si, depth)
        chain &= depth <= max_events
        last = depth + 1 == max_depth
        splits = mi.Bool(False) if glass is None else chain & whole & is_in(glass, bsdf, chain)
        radiance, si, throughput, active, chain, lobe = bounce(stage, si, bsdf, throughput, last, chain, sampler)
        mirrors = splits & mi.has_flag(lobe, mi.BSDFFlags.DeltaReflection)
        # Conditional expressions: without glass, nothing is added to the loop.
        reflections += 0 if glass is None else dr.select(mirrors, 1, 0)
        mirrored |= mirrors
        whole &= ~splits
        reflected += 0 if glass is None else dr.select(mirrored, radiance, 0)
        direct += dr.select(depth == 1, radiance, 0)
        indirect += dr.select(depth == 1, 0, radiance)
        # Russian roulette, from the second bounce on.
        survival = dr.select(depth > 1, dr.clip(ROULETTE * dr.max(throughput), 0.05, 1), 1)
        throughput = throughput / survival
        active &= sampler.next_1d() < survival
        depth += 1
        ended = ~active | (depth >= max_depth)
        si = dr.select(ended, primary, si)
        throughput = dr.select(ended, 1, throughput)
        depth = dr.select(ended, 1, depth)
        chain |= ended
        whole |= ended
        mirrored &= ~ended
        index += dr.select(ended, 1, 0)
    count = mi.Color3f(spp)
    return direct / count, indirect / count, reflected / count, mi.Float(reflections) / mi.Float(spp)


class SampleRange(NamedTuple):
    seed: int  # in [0, 2^32): different ones are independent, equal ones give equal bytes
    spp: int
    first: int = 0  # index of the first in a sequence


class PathTracer:
    """Path-traces the scene of a stage in its current pose.

    halton: draw from a cycle of 16 Halton points (see HaltonSampler), from the point `first` on.
    regularise: blur glossy materials from the second vertex of a path on (see BlurredTable); biased, less noisy.
    """

    def __init__(self, stage: Stage, halton: bool = False, regularise: bool = False):
        self.stage = stage
        self.every_pixel = dr.arange(mi.UInt32, stage.height * stage.width)
        dr.make_opaque(self.every_pixel)
        self.draw: type[Sampler] = HaltonSampler if halton else Sampler
        self.blurred = BlurredTable(stage) if regularise else None
        self.freezes = not halton and not regularise  # which Dr.Jit 1.5 cannot freeze

    def samples(
        self, ray: mi.Ray3f, pixel: mi.UInt32, seed: int, spp: int, first: int = 0, splits: bool = False
    ) -> tuple[mi.Color3f, mi.Color3f, mi.Color3f, mi.Float]:
        """(direct, indirect, reflected, share of reflections) along primary rays: see `sample_mean`.

        Each has the random numbers of its `pixel` (row-major). The last two are 0 unless glass `splits` paths.
        """
        max_events = self.stage.max_events(self.blurred is not None)
        numbers = (seed, first, spp, self.stage.scene.max_depth, max_events)
        data = [dr.opaque(mi.UInt32, number) for number in numbers]
        return self.stage.replay(sample_mean, ray, pixel, *data, self.draw, self.blurred, splits, freezes=self.freezes)

    def radiance(
        self, ray: mi.Ray3f, seed: int, spp: int, first: int = 0, splits: bool = False
    ) -> list[NDArray[np.float32]]:
        """[direct, indirect] radiance (H, W, 3), without emission, along the primary rays of all pixels.

        Where glass `splits` paths, also the part of it that glass reflects first and the share of such samples.
        """
        means = self.samples(ray, self.every_pixel, seed, spp, first, splits)
        return [self.stage.image(mean) for mean in (means if splits else means[:2])]


class PosedFrame:
    """One frame of a scene. The constructor poses `stage`; valid until it is posed again."""

    def __init__(self, stage: Stage, frame: int, regularise: bool = False):
        stage.pose(frame)
        view = stage.view(frame)
        self.emission = render_gbuffer(stage, view, regularise, in_layers=False)["emission"].astype(np.float64)
        self.ray = stage.rays(view)
        self.tracer = PathTracer(stage, regularise=regularise)

    def reflected(self, seed: int, spp: int) -> NDArray[np.float64]:
        """Direct + indirect radiance (H, W, 3) of `spp` samples a pixel; non-finite values are 0."""
        light = np.add(*self.tracer.radiance(self.ray, seed, spp))
        return np.nan_to_num(light.astype(np.float64), nan=0, posinf=0, neginf=0)
