"""Shading normals, perturbed by normal and bump maps."""

from collections.abc import Mapping
from typing import NamedTuple

from render.backend import dr, mi
from render.materials import BsdfParameters, registry_index


class Relief(NamedTuple):
    """The normal or bump map of a BSDF. On the back of a two-sided one it is that of the front, mirrored."""

    texture: mi.Texture
    bump: float | None  # the scale of heights; None where the texture holds normals
    two_sided: bool

    def local_normal(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Vector3f:
        """The normal (3,) in the shading frame at `si`."""
        if self.bump is None:
            normal = dr.normalize(2 * mi.Vector3f(self.texture.eval_3(si, active)) - 1)
        else:
            slope = self.bump * self.texture.eval_1_grad(si, active)
            n = si.sh_frame.n
            along_u = si.dp_du + n * (slope.x - dr.dot(n, si.dp_du))
            along_v = si.dp_dv + n * (slope.y - dr.dot(n, si.dp_dv))
            raised = dr.normalize(dr.cross(along_u, along_v))
            normal = si.to_local(dr.select(dr.dot(si.n, raised) < 0, -raised, raised))
        behind = mi.Bool(self.two_sided) & (si.wi.z < 0)
        return mi.Vector3f(normal.x, normal.y, dr.select(behind, -normal.z, normal.z))


def relief_of(bsdf: mi.BSDF, two_sided: bool = False) -> Relief | None:
    """The normal or bump map of a BSDF, or of the first that it wraps, if any."""
    parameters = BsdfParameters(bsdf)
    kind = bsdf.class_name()
    if kind == "NormalMap":
        return Relief(parameters.textures["normalmap"], None, two_sided)
    if kind == "BumpMap":
        return Relief(parameters.textures["nested_texture"], parameters.number("scale", 1.0), two_sided)
    nested = [*parameters.nested.values()]
    return relief_of(nested[0], two_sided or kind == "TwoSidedBRDF") if nested else None


class ShadingNormals:
    def __init__(self, bsdfs: Mapping[int, mi.BSDF]):
        reliefs = {number: relief_of(bsdf) for number, bsdf in bsdfs.items()}
        self.reliefs = {number: relief for number, relief in reliefs.items() if relief is not None}

    def evaluate(self, si: mi.SurfaceInteraction3f, hit: mi.Bool) -> mi.Vector3f:
        """The shading normal (3,) in the world at `si`, of unit length, on either side."""
        normal = mi.Vector3f(si.sh_frame.n)
        number = registry_index(si.bsdf())
        for index, relief in self.reliefs.items():  # sequential: a call by pointer would trace all textures
            here = hit & (number == index)
            normal = dr.select(here, si.to_world(relief.local_normal(si, here)), normal)
        return normal
