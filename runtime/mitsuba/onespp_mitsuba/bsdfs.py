"""Albedo, roughness and shading normals of all BSDFs of a scene.

Mitsuba has no query for an albedo that is right for metals, nor any for roughness: both follow from the textures and
numbers of a BSDF, which become functions of the surface interaction.
"""

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .colours import is_scalar, reflectance_of

MIN_PRINCIPLED_ALPHA = 0.001  # as in Mitsuba's plugin

Look = Callable[[Any, Any], tuple[Any, Any]]
"""From a surface interaction and a mask to (albedo, GGX alpha): a Color3f and a Float."""
Relief = Callable[[Any, Any], Any]
"""From a surface interaction and a mask to the shading normal in its shading frame, on either side."""


class Parts(mi.TraversalCallback):
    """The textures, nested BSDFs and numbers of a BSDF."""

    def __init__(self, bsdf: Any):
        super().__init__()
        self.textures: dict[str, Any] = {}
        self.nested: list[Any] = []
        bsdf.traverse(self)  # calls `put`
        self.numbers = mi.traverse(bsdf)

    def put(self, name: str, value: object, *_: object) -> None:
        """Called by Mitsuba for each parameter."""
        if isinstance(value, mi.Texture):
            self.textures[name] = value
        elif isinstance(value, mi.BSDF):
            self.nested.append(value)

    def number(self, name: str, si: Any, active: Any, default: float | None = None) -> Any:
        """A parameter that may be a texture or a number. Raises KeyError where there is neither, nor a default."""
        if name in self.textures:
            return self.textures[name].eval_1(si, active)
        return mi.Float(self.numbers[name]) if default is None or name in self.numbers else mi.Float(default)

    def alpha(self, si: Any, active: Any) -> Any:
        """The roughness, of anisotropic BSDFs the geometric mean of both directions; 0 by default."""
        if "alpha_u" not in self.textures:
            return self.number("alpha", si, active, 0.0)
        return dr.sqrt(self.number("alpha_u", si, active) * self.number("alpha_v", si, active))

    def reflectance(self, name: str, si: Any, active: Any) -> Any:
        return reflectance_of(lambda at: self.textures[name].eval(at, active), si)


def reflectance_at_normal(eta: Any) -> Any:
    """Fresnel reflectance at normal incidence of a dielectric of relative index of refraction `eta`."""
    return dr.square((eta - 1) / (eta + 1))


def diffuse(parts: Parts, si: Any, active: Any) -> tuple[Any, Any]:
    return parts.reflectance("reflectance", si, active), mi.Float(1)


def plastic(parts: Parts, si: Any, active: Any) -> tuple[Any, Any]:
    base = parts.reflectance("diffuse_reflectance", si, active)
    return base + reflectance_at_normal(parts.number("eta", si, active)), parts.alpha(si, active)


def nonlinear_plastic(parts: Parts, si: Any, active: Any) -> tuple[Any, Any]:
    """With the light that is reflected back inside, which saturates colours."""
    base = parts.reflectance("diffuse_reflectance", si, active)
    eta = parts.number("eta", si, active)
    internal = mi.fresnel_diffuse_reflectance(1 / eta)
    return base * (1 - internal) / (1 - internal * base) + reflectance_at_normal(eta), parts.alpha(si, active)


def conductor(parts: Parts, si: Any, active: Any) -> tuple[Any, Any]:
    def at_normal(at: Any) -> Any:
        eta, k = (parts.textures[name].eval(at, active) for name in ("eta", "k"))
        tint = (
            parts.textures["specular_reflectance"].eval(at, active) if "specular_reflectance" in parts.textures else 1
        )
        return tint * (dr.square(eta - 1) + dr.square(k)) / (dr.square(eta + 1) + dr.square(k))

    return reflectance_of(at_normal, si), parts.alpha(si, active)


def clear(parts: Parts, si: Any, active: Any) -> tuple[Any, Any]:
    """White: glass and null BSDFs absorb nothing."""
    return mi.Color3f(1), parts.alpha(si, active)


def principled(parts: Parts, si: Any, active: Any) -> tuple[Any, Any]:
    """Its glass is white."""
    if "specular" in parts.numbers:
        f0 = 0.08 * parts.number("specular", si, active)
    else:
        f0 = reflectance_at_normal(parts.number("eta", si, active))
    opaque = parts.reflectance("base_color", si, active)
    opaque += (1 - parts.number("metallic", si, active, 0.0)) * f0
    albedo = dr.lerp(opaque, mi.Color3f(1), parts.number("spec_trans", si, active, 0.0))
    return albedo, dr.maximum(dr.square(parts.number("roughness", si, active)), MIN_PRINCIPLED_ALPHA)


KNOWN: dict[str, Callable[[Parts, Any, Any], tuple[Any, Any]]] = {
    "SmoothDiffuse": diffuse,
    **dict.fromkeys(("SmoothPlastic", "RoughPlastic", "PolarizedPlastic"), plastic),
    **dict.fromkeys(("SmoothConductor", "RoughConductor"), conductor),
    **dict.fromkeys(("SmoothDielectric", "ThinDielectric", "RoughDielectric", "Null"), clear),
    **dict.fromkeys(("Principled", "PrincipledThin"), principled),
}


def unknown(bsdf: Any) -> Look:
    """By Mitsuba's own estimate of the albedo, and as rough as can be unless all is perfectly specular."""
    alpha = 1.0 if mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth) else 0.0
    return lambda si, active: (
        reflectance_of(lambda at: bsdf.eval_diffuse_reflectance(at, active), si),
        mi.Float(alpha),
    )


def mixture(first: Look, second: Look, weight: Callable[[Any, Any], Any]) -> Look:
    """The second where the weight is 1, the first where it is 0."""

    def look(si: Any, active: Any) -> tuple[Any, Any]:
        share = dr.clip(weight(si, active), 0, 1)
        (albedo, alpha), (other_albedo, other_alpha) = first(si, active), second(si, active)
        return dr.lerp(albedo, other_albedo, mi.Color3f(share)), dr.lerp(alpha, other_alpha, share)

    return look


def look_of(bsdf: Any) -> Look:
    parts, kind = Parts(bsdf), bsdf.class_name()
    nested = parts.nested
    if kind == "TwoSidedBRDF" and len(nested) == 2:
        front, back = map(look_of, nested)
        return mixture(front, back, lambda si, _: dr.select(si.wi.z < 0, mi.Float(1), mi.Float(0)))
    if kind in ("TwoSidedBRDF", "NormalMap", "BumpMap"):
        return look_of(nested[0])
    if kind == "MaskBSDF":
        white = mi.Color3f(1), mi.Float(0)
        return mixture(lambda *_: white, look_of(nested[0]), lambda *at: parts.number("opacity", *at))
    if kind == "BlendBSDF":
        first, second = map(look_of, nested)
        return mixture(first, second, lambda *at: parts.number("weight", *at))
    if kind not in KNOWN:
        return unknown(bsdf)
    # Mitsuba reports whether a plastic is nonlinear only in its description.
    of = nonlinear_plastic if KNOWN[kind] is plastic and "nonlinear = 1" in str(bsdf) else KNOWN[kind]
    return lambda si, active: of(parts, si, active)


def normal_map(texture: Any) -> Relief:
    return lambda si, active: dr.normalize(2 * mi.Vector3f(texture.eval_3(si, active)) - 1)


def bump_map(texture: Any, scale: float) -> Relief:
    def relief(si: Any, active: Any) -> Any:
        slope, n = scale * texture.eval_1_grad(si, active), si.sh_frame.n
        along_u = si.dp_du + n * (slope.x - dr.dot(n, si.dp_du))
        along_v = si.dp_dv + n * (slope.y - dr.dot(n, si.dp_dv))
        raised = dr.normalize(dr.cross(along_u, along_v))
        return si.to_local(dr.select(dr.dot(si.n, raised) < 0, -raised, raised))

    return relief


def mirrored_behind(relief: Relief) -> Relief:
    """As two-sided BSDFs have it."""

    def two_sided(si: Any, active: Any) -> Any:
        normal = relief(si, active)
        return mi.Vector3f(normal.x, normal.y, dr.select(si.wi.z < 0, -normal.z, normal.z))

    return two_sided


def relief_of(bsdf: Any) -> Relief | None:
    """Of the normal or bump map of a BSDF, or of the first that it wraps, if any."""
    parts, kind = Parts(bsdf), bsdf.class_name()
    if kind == "NormalMap":
        return normal_map(parts.textures["normalmap"])
    if kind == "BumpMap":
        return bump_map(parts.textures["nested_texture"], parts.numbers["scale"])
    relief = relief_of(parts.nested[0]) if parts.nested else None
    return mirrored_behind(relief) if relief and kind == "TwoSidedBRDF" else relief


Surface = tuple[Any, Any, Any]
"""(albedo in [0, 1], GGX alpha in [0, 1], shading normal in the world on either side)."""


def surface_of(bsdf: Any) -> Callable[[Any, Any], Surface]:
    look, relief = look_of(bsdf), relief_of(bsdf)

    def surface(si: Any, active: Any) -> Surface:
        albedo, alpha = look(si, active)
        normal = si.to_world(relief(si, active)) if relief else mi.Vector3f(si.sh_frame.n)
        return mi.Color3f(dr.clip(albedo, 0, 1)), mi.Float(dr.clip(alpha, 0, 1)), mi.Vector3f(normal)

    return surface


class Children(mi.TraversalCallback):
    """The objects that an object has as parameters."""

    def __init__(self, parent: Any):
        super().__init__()
        self.found: list[Any] = [parent.bsdf()] if isinstance(parent, mi.Shape) else []
        parent.traverse(self)  # calls `put`

    def put(self, _: str, value: object, *__: object) -> None:
        """Called by Mitsuba for each parameter."""
        if isinstance(value, mi.Object):
            self.found.append(value)


def bsdfs_of(scene: Any) -> dict[int, Any]:
    """The BSDFs of all shapes, also of those in groups, by address."""
    visited: set[int] = set()
    found: dict[int, Any] = {}
    left = [*scene.shapes(), scene]
    while left:
        each = left.pop()
        if each is None or each.ptr in visited:
            continue
        visited.add(each.ptr)
        if isinstance(each, mi.BSDF):
            found[each.ptr] = each
        else:
            left += Children(each).found
    return found


def is_smooth_glass(bsdf: Any) -> bool:
    flags = bsdf.flags()
    return bool(mi.has_flag(flags, mi.BSDFFlags.Transmission)) and not mi.has_flag(flags, mi.BSDFFlags.Smooth)


class Surfaces:
    """What surface interactions of a scene look like. Numbers of BSDFs count as they were when it was made."""

    def __init__(self, scene: Any):
        self.bsdfs = bsdfs_of(scene)
        self.surfaces = [surface_of(bsdf) for bsdf in self.bsdfs.values()]
        self.has_glass = any(map(is_smooth_glass, self.bsdfs.values()))
        self.position = {address: position for position, address in enumerate(self.bsdfs)}
        if is_scalar():
            return
        numbers = [int(np.array(registry_index(mi.BSDFPtr(bsdf)))[0]) for bsdf in self.bsdfs.values()]
        table = np.zeros(max(numbers, default=0) + 1, np.uint32)
        table[numbers] = np.arange(len(numbers))
        self.table = mi.UInt32(table)
        dr.make_opaque(self.table)

    def at(self, si: Any) -> Surface:
        """Where nothing is hit: white, rough and without a normal."""
        hit = si.is_valid()
        nothing = mi.Color3f(1), mi.Float(1), mi.Vector3f(0)
        if not self.surfaces:
            return nothing
        if is_scalar():
            return self.surfaces[self.position[si.bsdf().ptr]](si, True) if hit else nothing
        position = dr.gather(mi.UInt32, self.table, registry_index(si.bsdf()), hit)
        found: Surface = dr.switch(position, self.surfaces, si, active=hit)
        return dr.select(hit, found, nothing)


def registry_index(pointer: Any) -> Any:
    """The index of an instance in Dr.Jit's registry; 0 for none."""
    return dr.reinterpret_array(mi.UInt32, pointer)
