"""One object of every kind in built-in scenes, so that all of them share the same kernels.

Dr.Jit compiles the virtual calls of all living objects of a class into a kernel, and the largest number of such
objects; their content enters as data. So objects of all kinds are kept alive here, always in the same order, and the
number of further ones is bounded. Scenes with other kinds, more objects or a sky of another size get kernels of their
own.
"""

from functools import cache
from itertools import product
from typing import Any

import numpy as np

from render.backend import mi
from scenes.textures import SKY_SIZE

MAX_OBJECTS = {"BSDF": 256, "Texture": 1024, "Shape": 256, "Emitter": 16}
HALF_GREY = {"type": "rgb", "value": [0.5, 0.5, 0.5]}


def bitmap(channels: int) -> mi.Texture:
    values = mi.TensorXf(np.full((2, 2, channels), 0.5, np.float32))
    return mi.load_dict({"type": "bitmap", "raw": True, "data": values})


def materials() -> list[mi.BSDF]:
    """Every kind of material, with constants and with bitmaps."""
    kinds: list[dict[str, Any]] = []
    for colour in (HALF_GREY, bitmap(3)):
        plain = {"type": "diffuse", "reflectance": colour}
        kinds += [plain, {"type": "twosided", "bsdf": plain}]
        kinds += [{"type": kind, "diffuse_reflectance": colour} for kind in ("plastic", "roughplastic")]
        for roughness, metallic in product((0.5, bitmap(1)), (0.0, 0.5)):
            principled = {"type": "principled", "base_color": colour, "roughness": roughness}
            kinds.append(principled | {"metallic": metallic, "specular": 0.5})
    kinds += [{"type": "roughconductor", "material": "Cu", "alpha": alpha} for alpha in (0.1, bitmap(1))]
    kinds += [{"type": "conductor", "material": "Cu"}]
    kinds += [{"type": "dielectric", "int_ior": 1.5}, {"type": "roughdielectric", "int_ior": 1.5, "alpha": 0.1}]
    return [mi.load_dict(kind) for kind in kinds]


def mesh(normals: bool, coordinates: bool, emits: bool) -> mi.Mesh:
    """Two triangles, because arrays of one entry are compiled differently."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "diffuse"})
    if emits:
        properties["emitter"] = mi.load_dict({"type": "area", "radiance": HALF_GREY})
    square = mi.Mesh("palette", 4, 2, props=properties, has_vertex_normals=normals, has_vertex_texcoords=coordinates)
    parameters = mi.traverse(square)
    parameters["vertex_positions"] = mi.Float([0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0])
    parameters["faces"] = mi.UInt32([0, 1, 2, 1, 3, 2])
    if normals:
        parameters["vertex_normals"] = mi.Float([0, 0, 1] * 4)
    if coordinates:
        parameters["vertex_texcoords"] = mi.Float([0, 0, 1, 0, 0, 1, 1, 1])
    parameters.update()
    return square


@cache
def palette() -> list[object]:
    """Objects of all kinds, and of each class the last of the maximum number."""
    flags = (False, True)
    objects: list[object] = [*materials()]
    objects += [mi.load_dict({"type": "uniform", "value": 0.5})]
    objects += [mesh(normals, uv, emits) for emits in flags for normals in flags for uv in flags]
    sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((*SKY_SIZE, 3), np.float32))}
    objects += [mi.load_dict({"type": "scene", "sky": sky})]  # a sky depends on the extent of its scene
    fillers = {
        "BSDF": lambda: mi.load_dict({"type": "diffuse"}),
        "Texture": lambda: mi.load_dict({"type": "uniform", "value": 0.5}),
        "Shape": lambda: mesh(False, False, False),
        "Emitter": lambda: mi.load_dict({"type": "area", "radiance": HALF_GREY}),
    }
    return objects + [[fillers[name]() for _ in range(most)][-1] for name, most in MAX_OBJECTS.items()]
