"""Albedo and roughness of every BSDF, and whether it is a mirror.

albedo = diffuse reflectance + specular reflectance at normal incidence, so that demodulation removes the textures of
glossy surfaces too. Mitsuba has no query for it that is right for metals, nor any for roughness; both follow from the
textures and numbers of a BSDF, which are read once into tables. BSDFs that are not in MATERIAL_OF are measured at
normal incidence: one albedo and one roughness for the whole surface.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi


class Material(NamedTuple):
    """albedo = scale · base + (1 - metallic) · f0, and a GGX alpha: roughness, or its square where `squared`.

    `internal` is the internal diffuse Fresnel reflectance of a nonlinear plastic, whose base colour is
    base · (1 - internal) / (1 - internal · base).
    """

    base: mi.Texture  # colour
    roughness: mi.Texture
    metallic: mi.Texture
    scale: NDArray[np.float32]  # (3,)
    f0: float = 0.0
    squared: bool = False
    internal: float = 0.0


class Mixture(NamedTuple):
    """Two materials: the second where `weight` is 1, the first where it is 0; where `sided`, front and back."""

    first: "Material | Mixture"
    second: "Material | Mixture"
    weight: mi.Texture
    sided: bool = False


def depth_of(tree: Material | Mixture) -> int:
    """Of mixtures within each other."""
    return 1 + max(depth_of(tree.first), depth_of(tree.second)) if isinstance(tree, Mixture) else 0


def constant(value: float) -> mi.Texture:
    return mi.load_dict({"type": "uniform", "value": value})


class BsdfParameters(mi.TraversalCallback):
    """The textures, nested BSDFs and numbers of a Mitsuba BSDF, by name."""

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
        """The first component of a parameter that is no texture."""
        if default is not None and name not in self.numbers:
            return default
        return float(np.array(self.numbers[name]).ravel()[0])

    def alpha(self) -> mi.Texture:
        """The roughness, the geometric mean of both directions of anisotropic BSDFs; 0 by default."""
        if "alpha_u" not in self.textures:
            return self.textures.get("alpha") or constant(0)
        return constant(float(np.sqrt(self.colour("alpha_u").mean() * self.colour("alpha_v").mean())))

    def colour(self, name: str) -> NDArray[np.float64]:
        """The value (3,) of a constant texture, the mean of another."""
        texture = self.textures[name]
        if texture.is_spatially_varying():
            return np.full(3, mean_of(texture))
        return np.array(texture.eval(dr.zeros(mi.SurfaceInteraction3f)), np.float64)[:, 0]


def reflectance_at_normal(eta: float) -> float:
    """Fresnel reflectance at normal incidence of a dielectric of relative index of refraction `eta`."""
    return ((eta - 1) / (eta + 1)) ** 2


UNSCALED = np.ones(3, np.float32)
MAX_MIRROR_ALPHA = 0.1  # GGX; rougher surfaces show nothing sharply but what touches them


def plastic_material(parameters: BsdfParameters) -> Material:
    alpha = parameters.textures.get("alpha") or constant(parameters.number("alpha", 0.0))
    eta = parameters.colour("eta").mean() if "eta" in parameters.textures else parameters.number("eta")
    # Mitsuba reports whether a plastic is nonlinear only in its description.
    nonlinear = "nonlinear = 1" in str(parameters.bsdf)
    internal = float(np.array(mi.fresnel_diffuse_reflectance(mi.Float(1 / eta)))[0]) if nonlinear else 0.0
    base = parameters.textures["diffuse_reflectance"]
    gloss = parameters.colour("specular_reflectance").mean() if "specular_reflectance" in parameters.textures else 1.0
    return Material(base, alpha, constant(0), UNSCALED, gloss * reflectance_at_normal(eta), internal=internal)


def conductor_material(parameters: BsdfParameters) -> Material:
    eta = parameters.colour("eta")
    k = parameters.colour("k")
    f0 = ((eta - 1) ** 2 + k**2) / ((eta + 1) ** 2 + k**2)
    tint = parameters.textures.get("specular_reflectance") or constant(1)
    return Material(tint, parameters.alpha(), constant(1), f0.astype(np.float32))


def clear_material(parameters: BsdfParameters) -> Material:
    """Of dielectrics and null BSDFs, which absorb nothing: white."""
    return Material(constant(1), parameters.alpha(), constant(1), UNSCALED)


def principled_material(parameters: BsdfParameters) -> Material | Mixture:
    """Its glass is white."""
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
    "SmoothDiffuse": lambda bsdf: Material(bsdf.textures["reflectance"], constant(1), constant(0), UNSCALED),
    **dict.fromkeys(("SmoothPlastic", "RoughPlastic", "PolarizedPlastic"), plastic_material),
    **dict.fromkeys(("SmoothConductor", "RoughConductor"), conductor_material),
    **dict.fromkeys(("SmoothDielectric", "ThinDielectric", "RoughDielectric", "Null"), clear_material),
    **dict.fromkeys(("Principled", "PrincipledThin"), principled_material),
}
MIN_PRINCIPLED_ALPHA = 0.001  # as in Mitsuba's plugin
MAX_MIXTURE_DEPTH = 6  # each level doubles the evaluations


def material_of(bsdf: mi.BSDF, level: int = 0) -> Material | Mixture:
    """The material of a Mitsuba BSDF. BSDFs below MAX_MIXTURE_DEPTH mixtures are measured."""
    parameters = BsdfParameters(bsdf)
    nested = [*parameters.nested.values()]
    kind = bsdf.class_name()
    if level == MAX_MIXTURE_DEPTH and nested:
        return measured_material(bsdf)
    if kind == "TwoSidedBRDF" and len(nested) == 2 and nested[0] is not nested[1]:
        front, back = (material_of(side, level + 1) for side in nested)
        return Mixture(front, back, constant(0), sided=True)
    if kind in ("TwoSidedBRDF", "NormalMap", "BumpMap"):
        return material_of(nested[0], level)
    if kind == "MaskBSDF":
        inner = material_of(nested[0], level + 1)
        return Mixture(clear_material(parameters), inner, parameters.textures["opacity"])
    if kind == "BlendBSDF":
        first, second = (material_of(part, level + 1) for part in nested)
        return Mixture(first, second, parameters.textures["weight"])
    return MATERIAL_OF[kind](parameters) if kind in MATERIAL_OF else measured_material(bsdf)


MEASURED_SAMPLES = 1 << 14


def measured_material(bsdf: mi.BSDF) -> Material:
    """Albedo and roughness from samples of a BSDF at normal incidence.

    Half vectors of a GGX lobe have tan² θ = alpha² u / (1 - u) for uniform u there, with median alpha² (Walter et al.
    2007, Eq. 35).
    """
    si = dr.zeros(mi.SurfaceInteraction3f, MEASURED_SAMPLES)
    si.wi = mi.Vector3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(mi.Vector3f(0, 0, 1))
    si.n = mi.Normal3f(0, 0, 1)
    random = mi.PCG32(MEASURED_SAMPLES)
    uniform = [random.next_float32() for _ in range(3)]
    context = mi.BSDFContext(mi.TransportMode.Importance)
    sample, weight = bsdf.sample(context, si, uniform[0], mi.Point2f(uniform[1], uniform[2]))
    albedo = np.nan_to_num(np.array(weight, np.float32)).mean(axis=1)
    half = np.array(dr.normalize(sample.wo + si.wi))
    reflected = (np.array(sample.wo.z) > 0) & (np.array(sample.pdf) > 0)
    spread = (half[0] ** 2 + half[1] ** 2) / np.maximum(half[2] ** 2, 1e-12)
    diffuse = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
    alpha = 1.0 if diffuse or not reflected.any() else float(np.sqrt(np.median(spread[reflected])))
    return Material(constant(1), constant(min(alpha, 1)), constant(1), np.clip(albedo, 0, 1))


ColumnT = TypeVar("ColumnT", bound=dr.AnyArray)


def registry_index(pointer: mi.BSDFPtr | mi.ShapePtr) -> mi.UInt32:
    """The index of an instance in Dr.Jit's registry; 0 for none."""
    return cast(mi.UInt32, dr.reinterpret_array(mi.UInt32, pointer))


def registry_number(pointer: mi.BSDFPtr | mi.ShapePtr) -> int:
    return int(np.array(registry_index(pointer))[0])


def registry_table(kind: type[ColumnT], values: Mapping[int, int]) -> ColumnT:
    """A table of `values` by registry index, as data for kernels; 0 or false for all other indices."""
    table = kind([values.get(index, False) for index in range(max(values, default=0) + 1)])
    dr.make_opaque(table)
    return table


def is_in(members: mi.Bool, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Bool:
    """Whether a BSDF is one of those that a registry table names."""
    return dr.gather(mi.Bool, members, registry_index(bsdf), active)


def bsdfs_of(shapes: Iterable[mi.Shape]) -> dict[int, mi.BSDF]:
    """The BSDFs of Mitsuba shapes by registry index."""
    return {registry_number(mi.BSDFPtr(bsdf)): bsdf for bsdf in (shape.bsdf() for shape in shapes) if bsdf is not None}


def scatters(flags: mi.UInt32) -> mi.Bool:
    """Whether BSDFs with these flags are no mirrors: they are diffuse or transmit."""
    return mi.has_flag(flags, mi.BSDFFlags.Diffuse) | mi.has_flag(flags, mi.BSDFFlags.Transmission)


def may_be_mirror(bsdf: mi.BSDF, material: Material | Mixture) -> bool:
    """Whether a BSDF is a mirror where its roughness is the mean of its texture."""
    smooth = isinstance(material, Material) and mean_of(material.roughness) < MAX_MIRROR_ALPHA
    return smooth and not scatters(bsdf.flags())


def mean_of(texture: mi.Texture) -> float:
    """Infinite where Mitsuba does not know it, as of attributes of meshes."""
    try:
        return float(np.array(texture.mean())[0])
    except RuntimeError:
        return math.inf


class MaterialTable:
    """The materials of BSDFs: columns with a row for each, found by its registry index."""

    def __init__(self, bsdfs: Mapping[int, mi.BSDF]):
        # Keeps objects alive, which pointers do not.
        self.materials: list[Material] = []
        self.mixtures: dict[int, tuple[mi.Texture, int, int, bool]] = {}  # by row: weight, rows of both, sided
        trees = [material_of(bsdf) for bsdf in bsdfs.values()]
        self.depth = max(map(depth_of, trees), default=0)
        rows = [self.add(tree) for tree in trees]
        self.transmits = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Transmission) for bsdf in bsdfs.values())
        self.has_mirrors = any(map(may_be_mirror, bsdfs.values(), trees))
        if not rows:
            self.add(Material(constant(1), constant(1), constant(0), UNSCALED))  # an empty scene needs a row too
        table = np.zeros(max(bsdfs, default=0) + 1, np.uint32)
        table[list(bsdfs)] = rows
        self.row = mi.UInt32(table)
        base, roughness, metallic, scale, f0, squared, internal = zip(*self.materials, strict=True)
        self.base, self.roughness, self.metallic = map(mi.TexturePtr, map(list, (base, roughness, metallic)))
        self.scale = mi.Color3f(np.stack(scale, axis=1))
        self.f0 = mi.Float(np.array(f0, np.float32))
        self.squared = mi.Bool([*squared])
        self.internal = mi.Float(np.array(internal, np.float32))
        self.saturates = any(internal)
        # Rows that are no mixtures refer to themselves.
        self.unweighted = constant(0)
        mixtures = [self.mixtures.get(row, (self.unweighted, row, row, False)) for row in range(len(self.materials))]
        weight, first, second, sided = zip(*mixtures, strict=True)
        self.weight = mi.TexturePtr([*weight])
        self.first, self.second, self.sided = mi.UInt32([*first]), mi.UInt32([*second]), mi.Bool([*sided])
        self.columns = [self.base, self.roughness, self.metallic, self.scale, self.f0, self.squared, self.row]
        self.columns += [self.internal, self.weight, self.first, self.second, self.sided]
        # As data: unevaluated arrays would be compiled into kernels as literals, with the number of rows.
        dr.make_opaque(self.columns)

    def state(self) -> list[Any]:
        """All that kernels read of it."""
        textures = [[each.base, each.roughness, each.metallic] for each in self.materials]
        return [textures, [mixture[0] for mixture in self.mixtures.values()], self.unweighted, *self.columns]

    def add(self, tree: Material | Mixture) -> int:
        """Append a material, and those of a mixture. Returns its row."""
        row = len(self.materials)
        if isinstance(tree, Material):
            self.materials.append(tree)
            return row
        self.materials.append(Material(constant(1), constant(1), constant(0), UNSCALED))  # never evaluated
        self.mixtures[row] = (tree.weight, self.add(tree.first), self.add(tree.second), tree.sided)
        return row

    def evaluate(self, si: mi.SurfaceInteraction3f, hit: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """(albedo in [0, 1], GGX alpha in [0, 1]) at `si`; 1 and 1 where not `hit`."""
        row = dr.gather(mi.UInt32, self.row, registry_index(si.bsdf()), hit)
        albedo, alpha = self.mixed(row, self.depth, si, hit)
        return dr.select(hit, dr.clip(albedo, 0, 1), 1), dr.select(hit, dr.clip(alpha, 0, 1), 1)

    def mirror_at(self, si: mi.SurfaceInteraction3f) -> tuple[mi.Bool, mi.Color3f, mi.Float]:
        """(whether there is a mirror, its albedo, its GGX alpha) at `si`."""
        hit = si.is_valid()
        flags = si.bsdf().flags()
        faces = (si.wi.z > 0) | mi.has_flag(flags, mi.BSDFFlags.BackSide)
        no_mirror = scatters(flags)
        albedo, alpha = self.evaluate(si, hit)
        return hit & faces & ~no_mirror & (alpha < MAX_MIRROR_ALPHA), albedo, alpha

    def mixed(
        self, row: mi.UInt32, depth: int, si: mi.SurfaceInteraction3f, hit: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        """(albedo, alpha) of a row with mixtures up to `depth` levels deep."""
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
        alpha = dr.select(gather(self.squared), dr.maximum(roughness**2, MIN_PRINCIPLED_ALPHA), roughness)
        return albedo, alpha
