"""Whether BSDFs are perfectly specular, in part or altogether."""

from render.backend import mi
from render.materials import BsdfParameters


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
