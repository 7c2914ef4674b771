"""The BSDFs of a scene that are perfectly specular, in part or altogether."""

from collections.abc import Iterable, Mapping
from typing import ClassVar

import numpy as np

from render.backend import dr, mi
from render.materials import BsdfParameters, bsdfs_of, registry_index


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
