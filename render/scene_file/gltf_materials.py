"""glTF's materials as Mitsuba's, one description for all meshes of a material."""

from collections.abc import Callable
from functools import cache
from io import BytesIO
from typing import Any

import numpy as np
import trimesh

from errors import can_draw
from render.scene_file.assets import linear_image, stored_texture, texture, unit_values
from scenes.camera import Array
from scenes.colours import Bsdf, rgb

Json = dict[str, Any]
Colour = tuple[float, ...]  # red, green and blue, linear

UNTINTED: Colour = (1.0, 1.0, 1.0)
WRAP_MODES = {33071: "clamp", 33648: "mirror"}
NEAREST = 9728
FAINT = 0.05  # mean radiance under which a surface with a few small lights is no lamp
SURFACE_SAMPLES = 1 << 16  # of a mesh, for the mean of a texture
FLIP = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])  # of v, which points down in glTF


def transform_of(info: Json) -> Json:
    """The transform of a reference to a texture, whose default is none."""
    return dict(info.get("extensions", {}).get("KHR_texture_transform", {}))


def coordinate_set(info: Json) -> int:
    """The number of the set of texture coordinates."""
    return int(transform_of(info).get("texCoord", info.get("texCoord")) or 0)


def placement(info: Json) -> Array | None:
    """The transform (3, 3) of texture coordinates whose v points up; None for none."""
    transform = transform_of(info)
    if not transform.keys() & {"offset", "rotation", "scale"}:
        return None
    angle = transform.get("rotation", 0.0)
    matrix = np.eye(3)
    matrix[:2, :2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    matrix[:2, :2] *= transform.get("scale", (1.0, 1.0))
    matrix[:2, 2] = transform.get("offset", (0.0, 0.0))
    return FLIP @ matrix @ FLIP


def metallic_roughness(material: Json) -> Json:
    """Its metallic-roughness properties, or what comes closest to those of specular and glossiness."""
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if glossy is None:
        return dict(material.get("pbrMetallicRoughness", {}))
    renamed = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
    pbr = {renamed[key]: value for key, value in glossy.items() if key in renamed}
    return pbr | {"metallicFactor": 0.0, "roughnessFactor": 1 - glossy.get("glossinessFactor", 1.0)}


def surface_mean(mesh: trimesh.Trimesh, uv: Array, values: Array) -> Array:
    """The mean (C,) over a mesh's surface of a repeated image (H, W, C) whose first row is at v = 1."""
    rng = np.random.default_rng(0)
    areas = mesh.area_faces
    if not areas.any():  # nor does it emit anything
        return np.asarray(values.mean(axis=(0, 1)))
    faces = rng.choice(len(areas), SURFACE_SAMPLES, p=areas / areas.sum())
    corners = uv[mesh.faces[faces]]
    places = (rng.dirichlet(np.ones(3), SURFACE_SAMPLES)[..., None] * corners).sum(axis=1) % 1  # uniform on triangles
    height, width = values.shape[:2]
    rows = ((1 - places[:, 1]) * height).astype(int).clip(0, height - 1)
    columns = (places[:, 0] * width).astype(int).clip(0, width - 1)
    return np.asarray(values[rows, columns].mean(axis=0))


class GltfMaterials:
    """The materials of a file by index. Notes are added to `notes`.

    `content` is the content of an image or buffer of the JSON; it raises OSError for a file that is missing.
    """

    def __init__(self, json: Json, content: Callable[[Json], bytes], notes: list[str]):
        self.json = json
        self.content = content
        self.notes = notes
        self.bsdf = cache(self.describe)
        self.image = cache(self.read_image)

    def name(self, index: int) -> str:
        return str(self.json["materials"][index].get("name") or f"material {index}")

    def read_image(self, index: int) -> Any | None:
        """The image of a texture; None, with a note, if it cannot be read."""
        if not can_draw():
            return None
        from PIL import Image

        described = self.json["textures"][index]
        webp = described.get("extensions", {}).get("EXT_texture_webp", {})
        source = described.get("source", webp.get("source"))
        if source is None:
            self.notes.append(f"texture {index} is of an unknown kind: left out")
            return None
        try:
            image = Image.open(BytesIO(self.content(self.json["images"][source])))
            image.load()
        except FileNotFoundError:  # the resolver notes it
            return None
        except Exception as error:  # Pillow raises many kinds of exceptions for damaged files
            self.notes.append(f"image {source} is damaged ({type(error).__name__}): left out")
            return None
        return image

    def bitmap(self, info: Json | None, made: Callable[[Any], Bsdf]) -> Bsdf | None:
        """The texture that is `made` of an image, by a reference to it; None if there is none."""
        image = None if info is None else self.image(info["index"])
        if info is None or image is None:
            return None
        described = made(image)
        to_uv = placement(info)
        if to_uv is not None:
            described["to_uv"] = to_uv
        number = self.json["textures"][info["index"]].get("sampler")
        sampler = {} if number is None else self.json["samplers"][number]
        wraps = [WRAP_MODES.get(sampler.get(key, 0), "repeat") for key in ("wrapS", "wrapT")]
        if wraps[0] != wraps[1]:
            self.notes.append(f"texture {info['index']} is wrapped in two ways: '{wraps[0]}' along both axes instead")
        if wraps[0] != "repeat":
            described["wrap_mode"] = wraps[0]
        if sampler.get("magFilter") == NEAREST:
            described["filter_type"] = "nearest"
        return described

    def textures(self, index: int) -> list[Json]:
        """The references to the textures of a material's BSDF, in order of importance."""
        material = self.json["materials"][index]
        pbr = metallic_roughness(material)
        found = [pbr.get("baseColorTexture"), pbr.get("metallicRoughnessTexture"), material.get("normalTexture")]
        return [info for info in found if info is not None]

    def describe(self, index: int, tint: Colour = UNTINTED) -> Bsdf:
        """The metallic-roughness material as Mitsuba's principled one; `tint` multiplies its colour."""
        material, name = self.json["materials"][index], self.name(index)
        if material.get("alphaMode", "OPAQUE") != "OPAQUE":
            self.notes.append(f"{name}: transparency is left out: opaque instead")
        if len({coordinate_set(info) for info in self.textures(index)}) > 1:
            self.notes.append(f"{name}: several sets of texture coordinates: one of them for all textures instead")
        pbr = metallic_roughness(material)
        factor = np.multiply(pbr.get("baseColorFactor", UNTINTED)[:3], tint).clip(0, 1)

        def coloured(image: Any) -> Bsdf:
            return stored_texture(image, raw=False) if (factor == 1).all() else texture(linear_image(image) * factor)

        colour = self.bitmap(pbr.get("baseColorTexture"), coloured)
        bsdf: Bsdf = {"type": "principled", "base_color": colour or rgb(factor.tolist()), "specular": 0.5}
        for key, channel in (("roughness", 1), ("metallic", 2)):
            number = float(pbr.get(f"{key}Factor", 1.0))
            bsdf[key] = self.channel(pbr.get("metallicRoughnessTexture"), channel, number) or number
        relief = material.get("normalTexture")
        scale = 1.0 if relief is None else relief.get("scale", 1.0)

        def tilted(image: Any) -> Bsdf:
            if scale == 1:
                return stored_texture(image, raw=True)
            return texture(0.5 + (unit_values(image) - 0.5) * (scale, scale, 1.0))

        normals = self.bitmap(relief, tilted)
        if normals is not None:
            bsdf = {"type": "normalmap", "normalmap": normals, "bsdf": bsdf}
        return {"type": "twosided", "bsdf": bsdf}

    def channel(self, info: Json | None, number: int, factor: float) -> Bsdf | None:
        """A texture of one channel of an image, times a factor."""
        return self.bitmap(info, lambda image: texture(unit_values(image)[..., number : number + 1] * factor))

    def radiance(self, name: str, index: int, mesh: trimesh.Trimesh, uv: Callable[[Json], Array | None]) -> Array:
        """The mean emission (3,) of a mesh. `uv` are its texture coordinates for a reference to a texture."""
        material = self.json["materials"][index]
        strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {})
        factor = np.multiply(material.get("emissiveFactor", (0.0, 0.0, 0.0)), strength.get("emissiveStrength", 1.0))
        info = material.get("emissiveTexture")
        image = None if info is None or not factor.any() else self.image(info["index"])
        coordinates = None if info is None else uv(info)
        if image is None or info is None or coordinates is None:
            return factor
        to_uv = placement(info)
        if to_uv is not None:
            coordinates = coordinates @ to_uv[:2, :2].T + to_uv[:2, 2]
        mean = factor * surface_mean(mesh, coordinates, linear_image(image))
        if mean.max() < FAINT:
            self.notes.append(f"{name}: an emissive texture, dark on the whole: no emission instead")
            return np.zeros(3)
        self.notes.append(f"{name}: an emissive texture: its mean everywhere instead")
        return mean
