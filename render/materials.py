"""What the G-buffer says of a material: its albedo and its roughness, for every BSDF a scene may use.

albedo = diffuse reflectance + specular reflectance at normal incidence, so that dividing by it takes the textures of
glossy surfaces out of the signal too. Mitsuba has no query for it that is right for metals, nor any for roughness; both
follow from the textures and numbers of a BSDF, which are looked up once and kept in tables. What is not in MATERIAL_OF
is measured at normal incidence: one albedo and one roughness for all of its surface.
"""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type, assignment, operator, return-value"

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi


class Material(NamedTuple):
    """What the G-buffer says of one BSDF: albedo = scale · base + (1 - metallic) · f0, and a GGX alpha.

    alpha is the roughness, or its square where `squared`. `internal` is the diffuse Fresnel reflectance inside of a
    plastic whose colour saturates by it (`nonlinear`): its base is base · (1 - internal) / (1 - internal · base).
    """

    base: mi.Texture  # colour
    roughness: mi.Texture
    metallic: mi.Texture
    scale: NDArray[np.float32]  # (3,)
    f0: float = 0.0
    squared: bool = False
    internal: float = 0.0


class Mixture(NamedTuple):
    """Two materials: the second where `weight` is 1, the first where it is 0, or where `sided`, seen from behind."""

    first: "Material | Mixture"
    second: "Material | Mixture"
    weight: mi.Texture
    sided: bool = False


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
        self.bsdf = bsdf
        self.numbers = mi.traverse(bsdf)

    def put(self, name: str, value: object, *_: object) -> None:
        """Called by Mitsuba for each parameter."""
        if isinstance(value, mi.Texture):
            self.textures[name] = value
        elif isinstance(value, mi.BSDF):
            self.nested[name] = value

    def number(self, name: str, default: float | None = None) -> float:
        """The first component of a parameter that is no texture, or the default where there is no such parameter."""
        if default is not None and name not in self.numbers:
            return default
        return float(np.array(self.numbers[name]).ravel()[0])

    def alpha(self) -> mi.Texture:
        """The roughness, in the mean of both directions where they differ; 0 where there is none."""
        if "alpha_u" not in self.textures:
            return self.textures.get("alpha") or constant(0)
        return constant(float(np.sqrt(self.colour("alpha_u").mean() * self.colour("alpha_v").mean())))

    def colour(self, name: str) -> NDArray[np.float64]:
        """The value (3,) of a constant texture."""
        return np.array(self.textures[name].eval(dr.zeros(mi.SurfaceInteraction3f)), np.float64)[:, 0]


def reflectance_at_normal(eta: float) -> float:
    """Fresnel reflectance at normal incidence of a dielectric of relative index of refraction `eta`."""
    return ((eta - 1) / (eta + 1)) ** 2


def diffuse_fresnel(eta: float) -> float:
    """The same, of light from all directions alike."""
    return float(np.array(mi.fresnel_diffuse_reflectance(mi.Float(eta)))[0])


UNSCALED = np.ones(3, np.float32)
SMOOTH = 0.002  # GGX alpha below which a reflection is a picture: blurred by some pixels at most


def diffuse_material(parameters: BsdfParameters) -> Material:
    return Material(parameters.textures["reflectance"], constant(1), constant(0), UNSCALED)


def plastic_material(parameters: BsdfParameters) -> Material:
    alpha = parameters.textures.get("alpha") or constant(parameters.number("alpha", 0.0))
    eta = parameters.colour("eta").mean() if "eta" in parameters.textures else parameters.number("eta")
    # Whether a plastic is nonlinear Mitsuba tells by its description alone.
    internal = diffuse_fresnel(1 / eta) if "nonlinear = 1" in str(parameters.bsdf) else 0.0
    base = parameters.textures["diffuse_reflectance"]
    return Material(base, alpha, constant(0), UNSCALED, reflectance_at_normal(eta), internal=internal)


def conductor_material(parameters: BsdfParameters) -> Material:
    eta = parameters.colour("eta")
    k = parameters.colour("k")
    f0 = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
    tint = parameters.textures.get("specular_reflectance") or constant(1)
    return Material(tint, parameters.alpha(), constant(1), f0.astype(np.float32))


def dielectric_material(parameters: BsdfParameters) -> Material:
    """White: it absorbs nothing, only transmits and mirrors."""
    return Material(constant(1), parameters.alpha(), constant(1), UNSCALED)


def null_material(parameters: BsdfParameters) -> Material:
    """White: all light goes through."""
    return Material(constant(1), constant(0), constant(1), UNSCALED)


def principled_material(parameters: BsdfParameters) -> Material | Mixture:
    """White as far as it is glass."""
    textures = parameters.textures
    if "specular" in parameters.numbers:
        f0 = 0.08 * parameters.number("specular")
    elif "eta" in textures:
        f0 = reflectance_at_normal(float(parameters.colour("eta").mean()))
    else:
        f0 = reflectance_at_normal(parameters.number("eta"))
    metallic = textures.get("metallic") or constant(0)
    own = Material(textures["base_color"], textures["roughness"], metallic, UNSCALED, f0, squared=True)
    if "spec_trans" not in textures:
        return own
    glass = own._replace(base=constant(1), metallic=constant(1))
    return Mixture(own, glass, textures["spec_trans"])


MATERIAL_OF: dict[str, Callable[[BsdfParameters], Material | Mixture]] = {
    "SmoothDiffuse": diffuse_material,
    "SmoothPlastic": plastic_material,
    "RoughPlastic": plastic_material,
    "PolarizedPlastic": plastic_material,
    "SmoothConductor": conductor_material,
    "RoughConductor": conductor_material,
    "SmoothDielectric": dielectric_material,
    "ThinDielectric": dielectric_material,
    "RoughDielectric": dielectric_material,
    "Null": null_material,
    "Principled": principled_material,
    "PrincipledThin": principled_material,
}
SMALLEST_PRINCIPLED_ALPHA = 0.001  # as in Mitsuba's plugin


MOST_MIXED = 6  # mixtures within each other: each level doubles what is evaluated


def material_of(bsdf: mi.BSDF, level: int = 0) -> Material | Mixture:
    """The material of a Mitsuba BSDF, whatever wraps it. What lies below MOST_MIXED mixtures is measured."""
    parameters = BsdfParameters(bsdf)
    nested = [*parameters.nested.values()]
    kind = bsdf.class_name()
    if level == MOST_MIXED and nested:
        return measured_material(bsdf)
    if kind == "TwoSidedBRDF" and len(nested) == 2 and nested[0] is not nested[1]:
        return Mixture(material_of(nested[0], level + 1), material_of(nested[1], level + 1), constant(0), sided=True)
    if kind in ("TwoSidedBRDF", "NormalMap", "BumpMap"):
        return material_of(nested[0], level)
    if kind == "MaskBSDF":
        inner = material_of(nested[0], level + 1)
        return Mixture(null_material(parameters), inner, parameters.textures["opacity"])
    if kind == "BlendBSDF":
        return Mixture(
            material_of(nested[0], level + 1), material_of(nested[1], level + 1), parameters.textures["weight"]
        )
    return MATERIAL_OF[kind](parameters) if kind in MATERIAL_OF else measured_material(bsdf)


MEASURED_SAMPLES = 1 << 14


def measured_material(bsdf: mi.BSDF) -> Material:
    """What samples of a BSDF say at normal incidence: the light that it returns, and how far it spreads reflections.

    Half vectors of a GGX lobe, at normal incidence, have tan² θ = alpha² u / (1 - u) for an even u: its median is
    alpha² (Walter et al. 2007, Eq. 35).
    """
    si = dr.zeros(mi.SurfaceInteraction3f, MEASURED_SAMPLES)
    si.wi = mi.Vector3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    random = mi.PCG32(MEASURED_SAMPLES)
    uniform = [random.next_float32() for _ in range(3)]
    sample, weight = bsdf.sample(
        mi.BSDFContext(mi.TransportMode.Importance), si, uniform[0], mi.Point2f(uniform[1], uniform[2])
    )
    albedo = np.nan_to_num(np.array(weight, np.float32)).mean(axis=1)
    half = np.array(dr.normalize(sample.wo + si.wi))
    reflected = (np.array(sample.wo.z) > 0) & (np.array(sample.pdf) > 0)
    spread = (half[0] ** 2 + half[1] ** 2) / np.maximum(half[2] ** 2, 1e-12)
    diffuse = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
    alpha = 1.0 if diffuse or not reflected.any() else float(np.sqrt(np.median(spread[reflected])))
    return Material(constant(1), constant(min(alpha, 1)), constant(1), np.clip(albedo, 0, 1))


def registry_index(pointer: mi.BSDFPtr | mi.ShapePtr) -> mi.UInt32:
    """The number by which Dr.Jit knows an instance; 0 for none."""
    return cast(mi.UInt32, dr.reinterpret_array(mi.UInt32, pointer))


def registry_number(pointer: mi.BSDFPtr | mi.ShapePtr) -> int:
    """The same as a Python number."""
    return int(np.array(registry_index(pointer))[0])


def registry_table(pointers: Sequence[mi.BSDFPtr | mi.ShapePtr], first: int = 0) -> mi.UInt32:
    """A table from registry indices to places in `pointers`, counted from `first`; 0 for all other indices."""
    indices = [*map(registry_number, pointers)]
    table = np.zeros(max(indices, default=0) + 1, np.uint32)
    table[indices] = np.arange(len(indices)) + first
    return mi.UInt32(table)


def bsdfs_of(shapes: Iterable[mi.Shape]) -> dict[int, mi.BSDF]:
    """The BSDFs of Mitsuba shapes by their registry index, those that several share once."""
    return {registry_number(mi.BSDFPtr(bsdf)): bsdf for bsdf in (shape.bsdf() for shape in shapes) if bsdf is not None}


ColumnT = TypeVar("ColumnT", bound=dr.AnyArray)


def is_mirror(bsdf: mi.BSDF, material: Material | Mixture) -> bool:
    """Whether a BSDF of that material does nothing but reflect, and that like a mirror."""
    scatters = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse) or mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission)
    return not scatters and isinstance(material, Material) and float(np.array(material.roughness.mean())[0]) < SMOOTH


class MaterialTable:
    """The materials of Mitsuba shapes as columns, with a row for each, looked up by the BSDF's registry index."""

    def __init__(self, shapes: Sequence[mi.Shape]):
        # Objects live as long as the table does: pointers do not keep them.
        self.materials: list[Material] = []
        self.mixtures: dict[int, tuple[mi.Texture, int, int, bool]] = {}  # by row: weight, rows of both, sided
        bsdfs = bsdfs_of(shapes)
        trees = [material_of(bsdf) for bsdf in bsdfs.values()]
        self.depth = max(map(depth_of, trees), default=0)
        rows = [self.add(tree) for tree in trees]
        self.has_mirrors = any(map(is_mirror, bsdfs.values(), trees))
        if not rows:
            self.add(Material(constant(1), constant(1), constant(0), UNSCALED))  # an empty scene needs a row, too
        table = np.zeros(max(bsdfs, default=0) + 1, np.uint32)
        table[list(bsdfs)] = rows
        self.row = mi.UInt32(table)
        self.base = mi.TexturePtr([material.base for material in self.materials])
        self.roughness = mi.TexturePtr([material.roughness for material in self.materials])
        self.metallic = mi.TexturePtr([material.metallic for material in self.materials])
        self.scale = mi.Color3f(np.stack([material.scale for material in self.materials], axis=1))
        self.f0 = mi.Float(np.array([material.f0 for material in self.materials], np.float32))
        self.squared = mi.Bool([material.squared for material in self.materials])
        self.internal = mi.Float(np.array([material.internal for material in self.materials], np.float32))
        self.saturates = any(material.internal for material in self.materials)
        # As data: what is not evaluated yet would be compiled into kernels, with the number of rows.
        dr.make_opaque(self.base, self.roughness, self.metallic, self.scale, self.f0, self.squared, self.row)
        self.weight, self.first, self.second, self.sided = self.mixture_columns()
        dr.make_opaque(self.internal, self.weight, self.first, self.second, self.sided)

    def add(self, tree: Material | Mixture) -> int:
        """Append a material, and those that it is mixed of. Returns its row."""
        row = len(self.materials)
        if isinstance(tree, Material):
            self.materials.append(tree)
            return row
        self.materials.append(Material(constant(1), constant(1), constant(0), UNSCALED))  # is never looked at
        self.mixtures[row] = (tree.weight, self.add(tree.first), self.add(tree.second), tree.sided)
        return row

    def mixture_columns(self) -> tuple[mi.TexturePtr, mi.UInt32, mi.UInt32, mi.Bool]:
        """(weight, first, second, sided) of all rows; of those that are no mixtures both are the row itself."""
        plain = constant(0)
        self.plain = plain  # lives as long as the table
        rows = range(len(self.materials))
        columns = [self.mixtures.get(row, (plain, row, row, False)) for row in rows]
        weight, first, second, sided = zip(*columns, strict=True)
        return mi.TexturePtr([*weight]), mi.UInt32([*first]), mi.UInt32([*second]), mi.Bool([*sided])

    def evaluate(self, si: mi.SurfaceInteraction3f, hit: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """(albedo in [0, 1], GGX alpha in [0, 1]) at `si`; 1 and 1 where not `hit`."""
        row = dr.gather(mi.UInt32, self.row, registry_index(si.bsdf()), hit)
        albedo, alpha = self.mixed(row, self.depth, si, hit)
        return dr.select(hit, dr.clip(albedo, 0, 1), 1), dr.select(hit, dr.clip(alpha, 0, 1), 1)

    def mixed(
        self, row: mi.UInt32, depth: int, si: mi.SurfaceInteraction3f, hit: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        """(albedo, alpha) of a row that is mixed of mixtures, `depth` levels at most."""
        if depth == 0:
            return self.plain_material(row, si, hit)
        weight = dr.gather(mi.TexturePtr, self.weight, row, hit).eval(si, hit).x
        sided = dr.gather(mi.Bool, self.sided, row, hit)
        weight = dr.select(sided, dr.select(si.wi.z < 0, 1, 0), dr.clip(weight, 0, 1))
        first = self.mixed(dr.gather(mi.UInt32, self.first, row, hit), depth - 1, si, hit)
        second = self.mixed(dr.gather(mi.UInt32, self.second, row, hit), depth - 1, si, hit)
        return dr.lerp(first[0], second[0], weight), dr.lerp(first[1], second[1], weight)

    def plain_material(self, row: mi.UInt32, si: mi.SurfaceInteraction3f, hit: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """(albedo, alpha) of a row that is no mixture."""

        def gather(column: ColumnT) -> ColumnT:
            return dr.gather(type(column), column, row, hit)

        base = gather(self.base).eval(si, hit)
        if self.saturates:
            internal = gather(self.internal)
            base = base * (1 - internal) / (1 - internal * base)
        roughness = gather(self.roughness).eval(si, hit).x
        metallic = gather(self.metallic).eval(si, hit).x
        albedo = gather(self.scale) * base + (1 - metallic) * gather(self.f0)
        alpha = dr.select(gather(self.squared), dr.maximum(roughness**2, SMALLEST_PRINCIPLED_ALPHA), roughness)
        return albedo, alpha


def depth_of(tree: Material | Mixture) -> int:
    """How many mixtures lie within each other."""
    return 0 if isinstance(tree, Material) else 1 + max(depth_of(tree.first), depth_of(tree.second))
