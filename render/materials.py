"""What the G-buffer says of a material: its albedo and its roughness, for every BSDF a scene may use.

albedo = diffuse reflectance + specular reflectance at normal incidence, so that textures leave the signal of glossy
surfaces too. Mitsuba has no query for it that is right for metals, nor any for roughness; both follow from the
textures and numbers of a BSDF, which are looked up once and kept in tables.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from errors import BadInput
from render.backend import dr, mi


class Material(NamedTuple):
    """albedo = scale · base + (1 - metallic) · f0; GGX alpha = roughness, or its square."""

    base: Any  # mi.Texture, colour
    roughness: Any  # mi.Texture
    metallic: Any  # mi.Texture
    scale: NDArray[np.float32]  # (3,)
    f0: float = 0.0
    squared: bool = False


def constant(value: float) -> Any:
    return mi.load_dict({"type": "uniform", "value": value})


class Slots(mi.TraversalCallback):
    """The textures and nested BSDFs of a BSDF by name, and its numbers."""

    def __init__(self, bsdf: Any):
        super().__init__()
        self.objects: dict[str, Any] = {}
        bsdf.traverse(self)
        self.numbers = mi.traverse(bsdf)

    def put(self, name: str, value: Any, *_: Any) -> None:
        if isinstance(value, mi.Object):
            self.objects[name] = value

    def texture(self, name: str) -> Any:
        return self.objects.get(name)

    def number(self, name: str) -> float:
        return float(np.array(self.numbers[name]).ravel()[0])

    def colour(self, name: str) -> NDArray[np.float64]:
        """The value (3,) of a constant texture."""
        return np.array(self.objects[name].eval(dr.zeros(mi.SurfaceInteraction3f)), np.float64)[:, 0]


def reflectance_at_normal(eta: float) -> float:
    """Fresnel reflectance of a dielectric of relative index `eta` at normal incidence."""
    return ((eta - 1) / (eta + 1)) ** 2


WHITE = np.ones(3, np.float32)


def diffuse(slots: Slots) -> Material:
    return Material(slots.texture("reflectance"), constant(1), constant(0), WHITE)


def plastic(slots: Slots) -> Material:
    alpha = slots.number("alpha") if "alpha" in slots.numbers else 0.0
    f0 = reflectance_at_normal(slots.number("eta"))
    return Material(slots.texture("diffuse_reflectance"), constant(alpha), constant(0), WHITE, f0)


def conductor(slots: Slots) -> Material:
    eta, k = slots.colour("eta"), slots.colour("k")
    f0 = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
    tint = slots.texture("specular_reflectance") or constant(1)
    return Material(tint, slots.texture("alpha") or constant(0), constant(1), f0.astype(np.float32))


def dielectric(slots: Slots) -> Material:
    """Only transmits (and mirrors): white."""
    return Material(constant(1), slots.texture("alpha") or constant(0), constant(1), WHITE)


def principled(slots: Slots) -> Material:
    f0 = 0.08 * slots.number("specular") if "specular" in slots.numbers else reflectance_at_normal(slots.number("eta"))
    base, roughness, metallic = (slots.texture(name) for name in ("base_color", "roughness", "metallic"))
    return Material(base, roughness, metallic, WHITE, f0, squared=True)


DESCRIBE = {
    "SmoothDiffuse": diffuse,
    "SmoothPlastic": plastic,
    "RoughPlastic": plastic,
    "SmoothConductor": conductor,
    "RoughConductor": conductor,
    "SmoothDielectric": dielectric,
    "ThinDielectric": dielectric,
    "RoughDielectric": dielectric,
    "Principled": principled,
}
SMALLEST_PRINCIPLED_ALPHA = 0.001


def describe(bsdf: Any, shape: str) -> Material:
    """The material of a Mitsuba BSDF. Raises BadInput, naming the shape, for one that is not in the table."""
    slots = Slots(bsdf)
    if bsdf.class_name() == "TwoSidedBRDF":
        return describe(slots.objects["brdf_0"], shape)
    if bsdf.class_name() not in DESCRIBE or "alpha_u" in slots.objects:
        raise BadInput(
            f"shape '{shape}': the material {bsdf.class_name()} is not supported (isotropic ones of these are: "
            f"{', '.join(DESCRIBE)}, and TwoSidedBRDF around them)"
        )
    return DESCRIBE[bsdf.class_name()](slots)


def registry_index(pointer: Any) -> Any:
    """mi.UInt32: the number by which Dr.Jit knows an instance."""
    return dr.reinterpret_array(mi.UInt32, pointer)


def registry_table(pointers: Sequence[Any], first: int = 0) -> Any:
    """mi.UInt32 table from registry indices to places in `pointers`, counted from `first`; 0 for all others."""
    indices = [int(np.array(registry_index(pointer))[0]) for pointer in pointers]
    table = np.zeros(max(indices, default=0) + 1, np.uint32)
    table[indices] = np.arange(len(indices)) + first
    return mi.UInt32(table)


class MaterialTable:
    """Albedo and roughness of the BSDFs of Mitsuba shapes, looked up by registry index."""

    def __init__(self, shapes: Sequence[Any]):
        # Objects live as long as the table does: pointers do not keep them.
        nothing = Material(constant(1), constant(1), constant(0), WHITE)  # an empty scene needs a row, too
        self.materials = [describe(shape.bsdf(), shape.id()) for shape in shapes] or [nothing]
        self.row = registry_table([mi.BSDFPtr(shape.bsdf()) for shape in shapes])
        self.base, self.roughness, self.metallic = (
            mi.TexturePtr([getattr(material, name) for material in self.materials])
            for name in ("base", "roughness", "metallic")
        )
        self.scale = mi.Color3f(np.stack([material.scale for material in self.materials], axis=1))
        self.f0 = mi.Float(np.array([material.f0 for material in self.materials], np.float32))
        self.squared = mi.Bool([material.squared for material in self.materials])

    def evaluate(self, si: Any, hit: Any) -> tuple[Any, Any]:
        """(albedo mi.Color3f in [0, 1], GGX alpha mi.Float in [0, 1]) at `si`; 1 and 1 where not `hit`."""
        row = dr.gather(mi.UInt32, self.row, registry_index(si.bsdf()), hit)

        def gather(table: Any) -> Any:
            return dr.gather(type(table), table, row, hit)

        base, roughness, metallic = (
            gather(table).eval(si, hit) for table in (self.base, self.roughness, self.metallic)
        )
        albedo = gather(self.scale) * base + (1 - metallic.x) * gather(self.f0)
        alpha = dr.select(gather(self.squared), dr.maximum(roughness.x**2, SMALLEST_PRINCIPLED_ALPHA), roughness.x)
        return dr.select(hit, dr.clip(albedo, 0, 1), 1), dr.select(hit, dr.clip(alpha, 0, 1), 1)
