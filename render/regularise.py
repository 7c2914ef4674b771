"""Path-space regularisation: glossy materials are blurred from the second vertex of a path on.

Kaplanyan and Dachsbacher 2013, "Path Space Regularization for Holistic and Robust Light Transport", as used by RAE
§3.1: paths that hit a mirror or a sharp highlight after a diffuse bounce are hardly ever sampled and become fireflies.
With more roughness they are sampled often; caustics and reflections of reflections become too soft.
"""

from typing import Any

import numpy as np

from render.backend import dr, mi
from render.loading import StockLoader
from render.materials import registry_index, registry_table
from render.stage import Stage

MIN_BLURRED_ALPHA = 0.3
ROUGH = {"conductor": "roughconductor", "plastic": "roughplastic", "dielectric": "roughdielectric"}
Roughness = float | dict[str, Any]  # a number or a texture, as in a Mitsuba dictionary


def at_least(roughness: Roughness, least: float) -> Roughness:
    """Textures whose values are not at hand, such as those of files, become `least` everywhere."""
    if not isinstance(roughness, dict):
        return max(roughness, least)
    if "data" in roughness:
        return roughness | {"data": np.maximum(roughness["data"], least)}
    return roughness | {"value": max(roughness["value"], least)} if "value" in roughness else least


def blurred(bsdf: dict[str, Any]) -> dict[str, Any]:
    """The Mitsuba BSDF dictionary with a GGX alpha of at least MIN_BLURRED_ALPHA, as far as it or BSDFs in it have one.

    Textures, which have none, come out as they are.
    """
    nested = {key: blurred(value) if isinstance(value, dict) else value for key, value in bsdf.items()}
    kind = ROUGH.get(bsdf["type"], bsdf["type"])
    if kind in ROUGH.values():
        given = {key: bsdf[key] for key in ("alpha", "alpha_u", "alpha_v") if key in bsdf} or {"alpha": 0.0}
        return nested | {"type": kind} | {key: at_least(alpha, MIN_BLURRED_ALPHA) for key, alpha in given.items()}
    if kind == "principled":
        return nested | {"roughness": at_least(bsdf.get("roughness", 0.5), MIN_BLURRED_ALPHA**0.5)}
    return nested


class BlurredTable:
    """The blurred versions of all BSDFs of a stage, by registry index; those that nothing describes as they are."""

    def __init__(self, stage: Stage):
        self.row = registry_table(mi.UInt32, {index: row for row, index in enumerate(stage.bsdfs)})
        described = stage.bsdf_descriptions
        loader = StockLoader(stage.unit)
        # Keeps objects alive, which pointers do not.
        self.bsdfs = [
            loader.load(blurred(described[index])) if index in described else own for index, own in stage.bsdfs.items()
        ]
        self.pointers = mi.BSDFPtr(self.bsdfs)

    def after_first(self, si: mi.SurfaceInteraction3f, depth: mi.UInt32) -> mi.BSDFPtr:
        """The surface's BSDF at depth 1, the blurred one from then on."""
        own = si.bsdf()
        row = dr.gather(mi.UInt32, self.row, registry_index(own), si.is_valid())
        return dr.select(depth > 1, dr.gather(mi.BSDFPtr, self.pointers, row, si.is_valid()), own)
