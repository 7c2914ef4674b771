"""What the G-buffer says of a material: its albedo and its roughness, for every BSDF a scene may use.

albedo = diffuse reflectance + specular reflectance at normal incidence, so that dividing by it takes the textures of
glossy surfaces out of the signal too. Mitsuba has no query for it that is right for metals, nor any for roughness; both
follow from the textures and numbers of a BSDF, which are looked up once and kept in tables.
"""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type, operator, return-value"

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from errors import BadInput
from render.backend import dr, mi


class Material(NamedTuple):
    """What the G-buffer says of one BSDF: albedo = scale · base + (1 - metallic) · f0, and a GGX alpha.

    alpha is the roughness, or its square where `squared`.
    """

    base: mi.Texture  # colour
    roughness: mi.Texture
    metallic: mi.Texture
    scale: NDArray[np.float32]  # (3,)
    f0: float = 0.0
    squared: bool = False


def constant(value: float) -> mi.Texture:
    """The same number everywhere."""
    return mi.load_dict({"type": "uniform", "value": value})


class BsdfParameters(mi.TraversalCallback):
    """What a Mitsuba BSDF is made of, by name: its textures, the BSDFs nested in it and its numbers."""

    def __init__(self, bsdf: mi.BSDF):
        super().__init__()
        self.textures: dict[str, mi.Texture] = {}
        self.nested: dict[str, mi.BSDF] = {}
        bsdf.traverse(self)  # calls `put`
        self.numbers = mi.traverse(bsdf)

    def put(self, name: str, value: object, *_: object) -> None:
        """Called by Mitsuba for each parameter."""
        if isinstance(value, mi.Texture):
            self.textures[name] = value
        elif isinstance(value, mi.BSDF):
            self.nested[name] = value

    def number(self, name: str) -> float:
        """The first component of a parameter that is no texture."""
        return float(np.array(self.numbers[name]).ravel()[0])

    def colour(self, name: str) -> NDArray[np.float64]:
        """The value (3,) of a constant texture."""
        return np.array(self.textures[name].eval(dr.zeros(mi.SurfaceInteraction3f)), np.float64)[:, 0]


def reflectance_at_normal(eta: float) -> float:
    """Fresnel reflectance at normal incidence of a dielectric of relative index of refraction `eta`."""
    return ((eta - 1) / (eta + 1)) ** 2


UNSCALED = np.ones(3, np.float32)


def diffuse_material(parameters: BsdfParameters) -> Material:
    return Material(parameters.textures["reflectance"], constant(1), constant(0), UNSCALED)


def plastic_material(parameters: BsdfParameters) -> Material:
    alpha = parameters.number("alpha") if "alpha" in parameters.numbers else 0.0
    f0 = reflectance_at_normal(parameters.number("eta"))
    return Material(parameters.textures["diffuse_reflectance"], constant(alpha), constant(0), UNSCALED, f0)


def conductor_material(parameters: BsdfParameters) -> Material:
    eta = parameters.colour("eta")
    k = parameters.colour("k")
    f0 = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
    tint = parameters.textures.get("specular_reflectance") or constant(1)
    alpha = parameters.textures.get("alpha") or constant(0)
    return Material(tint, alpha, constant(1), f0.astype(np.float32))


def dielectric_material(parameters: BsdfParameters) -> Material:
    """White: it absorbs nothing, only transmits and mirrors."""
    alpha = parameters.textures.get("alpha") or constant(0)
    return Material(constant(1), alpha, constant(1), UNSCALED)


def principled_material(parameters: BsdfParameters) -> Material:
    if "specular" in parameters.numbers:
        f0 = 0.08 * parameters.number("specular")
    else:
        f0 = reflectance_at_normal(parameters.number("eta"))
    textures = parameters.textures
    return Material(textures["base_color"], textures["roughness"], textures["metallic"], UNSCALED, f0, squared=True)


MATERIAL_OF: dict[str, Callable[[BsdfParameters], Material]] = {
    "SmoothDiffuse": diffuse_material,
    "SmoothPlastic": plastic_material,
    "RoughPlastic": plastic_material,
    "SmoothConductor": conductor_material,
    "RoughConductor": conductor_material,
    "SmoothDielectric": dielectric_material,
    "ThinDielectric": dielectric_material,
    "RoughDielectric": dielectric_material,
    "Principled": principled_material,
}
SMALLEST_PRINCIPLED_ALPHA = 0.001  # as in Mitsuba's plugin


def material_of(bsdf: mi.BSDF, shape: str) -> Material:
    """The material of a Mitsuba BSDF. Raises BadInput, naming the shape, for one that is not in the table."""
    parameters = BsdfParameters(bsdf)
    kind = bsdf.class_name()
    if kind == "TwoSidedBRDF":
        return material_of(parameters.nested["brdf_0"], shape)
    if kind not in MATERIAL_OF or "alpha_u" in parameters.textures:
        raise BadInput(
            f"shape '{shape}': the material {kind} is not supported (isotropic ones of these are: "
            f"{', '.join(MATERIAL_OF)}, and TwoSidedBRDF around them)"
        )
    return MATERIAL_OF[kind](parameters)


def registry_index(pointer: mi.BSDFPtr | mi.ShapePtr) -> mi.UInt32:
    """The number by which Dr.Jit knows an instance; 0 for none."""
    return cast(mi.UInt32, dr.reinterpret_array(mi.UInt32, pointer))


def registry_table(pointers: Sequence[mi.BSDFPtr | mi.ShapePtr], first: int = 0) -> mi.UInt32:
    """A table from registry indices to places in `pointers`, counted from `first`; 0 for all other indices."""
    indices = [int(np.array(registry_index(pointer))[0]) for pointer in pointers]
    table = np.zeros(max(indices, default=0) + 1, np.uint32)
    table[indices] = np.arange(len(indices)) + first
    return mi.UInt32(table)


ColumnT = TypeVar("ColumnT", bound=dr.AnyArray)


class MaterialTable:
    """The materials of Mitsuba shapes as columns, with a row for each, looked up by the BSDF's registry index."""

    def __init__(self, shapes: Sequence[mi.Shape]):
        # Objects live as long as the table does: pointers do not keep them.
        nothing = Material(constant(1), constant(1), constant(0), UNSCALED)  # an empty scene needs a row, too
        self.materials = [material_of(shape.bsdf(), shape.id()) for shape in shapes] or [nothing]
        self.row = registry_table([mi.BSDFPtr(shape.bsdf()) for shape in shapes])
        self.base = mi.TexturePtr([material.base for material in self.materials])
        self.roughness = mi.TexturePtr([material.roughness for material in self.materials])
        self.metallic = mi.TexturePtr([material.metallic for material in self.materials])
        self.scale = mi.Color3f(np.stack([material.scale for material in self.materials], axis=1))
        self.f0 = mi.Float(np.array([material.f0 for material in self.materials], np.float32))
        self.squared = mi.Bool([material.squared for material in self.materials])
        # As data: what is not evaluated yet would be compiled into kernels, with the number of rows.
        dr.make_opaque(self.base, self.roughness, self.metallic, self.scale, self.f0, self.squared, self.row)

    def evaluate(self, si: mi.SurfaceInteraction3f, hit: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """(albedo in [0, 1], GGX alpha in [0, 1]) at `si`; 1 and 1 where not `hit`."""
        row = dr.gather(mi.UInt32, self.row, registry_index(si.bsdf()), hit)

        def gather(column: ColumnT) -> ColumnT:
            return dr.gather(type(column), column, row, hit)

        base = gather(self.base).eval(si, hit)
        roughness = gather(self.roughness).eval(si, hit).x
        metallic = gather(self.metallic).eval(si, hit).x
        albedo = gather(self.scale) * base + (1 - metallic) * gather(self.f0)
        alpha = dr.select(gather(self.squared), dr.maximum(roughness**2, SMALLEST_PRINCIPLED_ALPHA), roughness)
        return dr.select(hit, dr.clip(albedo, 0, 1), 1), dr.select(hit, dr.clip(alpha, 0, 1), 1)
