"""Light seen by way of mirrors and glass, as free of noise as light seen directly.

Chains of perfectly specular events (delta lobes) need no random numbers: from each such surface every branch is
followed, and the light at its end, weighted by the chain's throughput, is emission. The path tracer leaves it out.
"""

from collections.abc import Iterable, Mapping
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.lights import Lights
from render.loading import columns, upload
from render.materials import BsdfParameters, bsdfs_of, registry_index
from render.palette import palette

MAX_EVENTS = 8  # in a chain: through a vitrine of solid panes, and a bottle in it


def is_masked(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF has a mask in it: Mitsuba cannot sample a single lobe of one."""
    return bsdf.class_name() == "MaskBSDF" or any(map(is_masked, BsdfParameters(bsdf).nested.values()))


def has_flag(bsdf: mi.BSDF, component: int, flag: mi.BSDFFlags) -> bool:
    return bool(mi.has_flag(bsdf.flags(component), flag))


def delta_lobes(bsdf: mi.BSDF) -> list[int]:
    """The component indices of the delta lobes that can be sampled alone."""
    if is_masked(bsdf):
        return []
    return [i for i in range(bsdf.component_count()) if has_flag(bsdf, i, mi.BSDFFlags.Delta)]


def is_smooth_glass(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF reflects and transmits perfectly specularly, and nothing else."""
    lobes = delta_lobes(bsdf)
    reflects = [has_flag(bsdf, i, mi.BSDFFlags.DeltaReflection) for i in lobes]
    return len(lobes) == bsdf.component_count() and any(reflects) and not all(reflects)


class BsdfSet:
    """Some of the BSDFs of a scene: `membership` of each, by its registry index."""

    DRJIT_STRUCT: ClassVar = {"members": mi.Bool}

    def __init__(self, membership: Mapping[int, bool] | None = None):
        if membership is None:  # Dr.Jit creates empty instances
            return
        members = np.zeros(max(membership, default=0) + 1, bool)
        members[[*membership]] = [*membership.values()]
        self.members = mi.Bool(members)
        dr.make_opaque(self.members)

    def at(self, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
        """Whether a BSDF belongs to it."""
        return dr.gather(mi.Bool, self.members, registry_index(bsdf), active)


class SpecularSurfaces(BsdfSet):
    """The BSDFs of `shapes` that chains continue from; `lobes` are the component indices of their delta lobes."""

    def __init__(self, shapes: Iterable[mi.Shape] | None = None):
        lobes = {index: delta_lobes(bsdf) for index, bsdf in bsdfs_of(shapes or ()).items()}
        super().__init__(None if shapes is None else {index: bool(of_bsdf) for index, of_bsdf in lobes.items()})
        self.lobes = sorted({lobe for of_bsdf in lobes.values() for lobe in of_bsdf})


def smooth_glass(shapes: Iterable[mi.Shape]) -> BsdfSet | None:
    """The BSDFs of smooth glass; None where there are none."""
    membership = {index: is_smooth_glass(bsdf) for index, bsdf in bsdfs_of(shapes).items()}
    return BsdfSet(membership) if any(membership.values()) else None


class Chains(NamedTuple):
    """Chains of perfectly specular events: several for a pixel that shows glass, none for many."""

    pixel: NDArray[np.integer]  # (N,)
    rays: NDArray[np.float32]  # (N, 9): origin and direction of the last ray, and throughput


Branch = tuple[mi.Bool, list[mi.Float]]  # where a lobe continues chains; origin, direction and throughput then


def branches_at_end(
    scene: mi.Scene, lights: Lights, specular: SpecularSurfaces, rays: list[mi.Float], lobes: list[int]
) -> tuple[mi.Color3f, list[Branch]]:
    """(radiance from where `rays` end, a branch for each of the delta lobes there)."""
    origin, direction, throughput = mi.Point3f(rays[:3]), mi.Vector3f(rays[3:6]), mi.Color3f(rays[6:])
    si = scene.ray_intersect(mi.Ray3f(origin, direction), mi.RayFlags.All, coherent=False)
    active = si.is_valid()
    active &= specular.at(si.bsdf(), active)
    branches: list[Branch] = []
    for lobe in lobes:
        context = mi.BSDFContext()
        context.component = lobe
        sample, weight = si.bsdf().sample(context, si, 0.5, mi.Point2f(0.5), active)
        weight = throughput * weight
        follows = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta) & dr.any(weight > 0)
        onward = si.spawn_ray(si.to_world(sample.wo))
        branches.append((follows, [*onward.o, *onward.d, *weight]))
    return throughput * lights.at(si).eval(si), branches


def advance(chains: Chains, branches: list[Branch]) -> Chains:
    """The chains with one event more: one for each delta lobe at their ends."""
    pixels = [chains.pixel[:0], *(chains.pixel[np.array(follows)] for follows, _ in branches)]
    rays = [chains.rays[:0], *(columns(ray)[np.array(follows)] for follows, ray in branches)]
    return Chains(np.concatenate(pixels), np.concatenate(rays))


def specular_light(
    scene: mi.Scene,
    lights: Lights,
    specular: SpecularSurfaces,
    ray: mi.Ray3f,
    max_events: int,
    shines: NDArray[np.bool_] | None = None,
    freezes: bool = False,
) -> NDArray[np.float32]:
    """Radiance (N, 3) of lights and sky along `ray`, directly visible and after up to `max_events` specular events.

    shines: (N,), the rays to follow; by default all. It is 0 for the others.
    freezes: whether Dr.Jit can freeze the scene's light transport (see PathTracer).
    """
    count = dr.width(ray.d)
    values = [np.broadcast_to(np.array(value), count) for value in (*ray.o, *ray.d, *mi.Color3f(1))]
    pixel = np.arange(count) if shines is None else np.flatnonzero(shines)
    chains = Chains(pixel, np.stack(values, axis=-1)[pixel])
    total = np.zeros((count, 3))
    # Tracing the program in Python takes longer than running it; all events share one recording.
    follow = dr.freeze(branches_at_end, state_fn=lambda *_, **__: palette()) if freezes else branches_at_end
    for _ in range(max_events + 1):
        if len(chains.pixel):
            rays = [*map(upload, chains.rays.T)]
            radiance, branches = follow(scene, lights, specular, rays, specular.lobes)
            dr.eval(radiance, branches)  # in one kernel
            np.add.at(total, chains.pixel, columns(radiance))  # in the order of chains; Dr.Jit would add in any order
            chains = advance(chains, branches)
    return total.astype(np.float32)
