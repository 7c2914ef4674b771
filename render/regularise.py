"""Path-space regularisation: glossy materials are blurred where a path has scattered before.

After Kaplanyan and Dachsbacher (2013), as RAE §3.1 uses it: paths that meet a mirror or a sharp highlight only after a
diffuse bounce are nearly never sampled and become fireflies. With more roughness they are found often, and caustics and
reflections within reflections become softer than they are.
"""

from typing import Any

import numpy as np

from render.backend import dr, mi
from render.materials import registry_index, registry_table
from render.stage import Stage, to_mitsuba

LEAST_ALPHA = 0.3


def at_least(value: Any, least: float) -> Any:
    """A roughness of a Mitsuba dictionary, number or bitmap, nowhere below `least`."""
    if isinstance(value, dict):
        key = "data" if "data" in value else "value"
        return {**value, key: np.maximum(value[key], least) if key == "data" else max(value[key], least)}
    return max(value, least)


ROUGH = {"conductor": "roughconductor", "plastic": "roughplastic", "dielectric": "roughdielectric"}


def blurred(bsdf: dict[str, Any]) -> dict[str, Any]:
    """The BSDF with GGX alpha of at least LEAST_ALPHA; what has none stays as it is."""
    nested = {key: blurred(value) if is_bsdf(value) else value for key, value in bsdf.items()}
    kind = ROUGH.get(bsdf["type"], bsdf["type"])
    if kind in ROUGH.values():
        return {**nested, "type": kind, "alpha": at_least(bsdf.get("alpha", 0.0), LEAST_ALPHA)}
    if kind == "principled":
        return {**nested, "roughness": at_least(bsdf.get("roughness", 0.5), LEAST_ALPHA**0.5)}
    return nested


def is_bsdf(value: Any) -> bool:
    return isinstance(value, dict) and value.get("type") in (*ROUGH, *ROUGH.values(), "principled", "diffuse")


class BlurredTable:
    """For every BSDF of a stage its blurred version."""

    def __init__(self, stage: Stage):
        self.row = registry_table([mi.BSDFPtr(shape.bsdf()) for shape in stage.shapes])
        # Objects live as long as the table does: pointers do not keep them.
        self.bsdfs = [mi.load_dict(to_mitsuba(blurred(shape.bsdf))) for shape in stage.scene.shapes]
        self.pointers = mi.BSDFPtr(self.bsdfs)

    def after_first(self, si: Any, depth: Any) -> Any:
        """mi.BSDFPtr: the surface's own at depth 1, the blurred one from then on."""
        own = si.bsdf()
        row = dr.gather(mi.UInt32, self.row, registry_index(own), si.is_valid())
        return dr.select(depth > 1, dr.gather(mi.BSDFPtr, self.pointers, row, si.is_valid()), own)
