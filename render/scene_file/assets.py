"""What readers of mesh files share: the files that these refer to, images as textures, and checks of meshes."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver
from trimesh.visual import TextureVisuals

from errors import BadInput
from render.loading import BAD_COORDINATES, BAD_NORMALS, MAX_EXTENT, without_direction
from scenes.animation import Shape
from scenes.camera import Array
from scenes.colours import Bsdf, diffuse_bsdf, srgb_to_linear

# What may precede the name of a texture in an OBJ's materials: "-s 2 2 1 -clamp on".
OPTIONS = re.compile(r"^(-[a-z]+\s+((on|off|[rgbmlz]|[-+]?[\d.]+(e[-+]?\d+)?)\s+)+)+", re.IGNORECASE)


class InsideResolver(FilePathResolver):
    """Reads the files that a mesh file refers to, from its own folder only."""

    def __init__(self, path: Path):
        super().__init__(str(path))
        self.outside: list[str] = []  # names outside of the folder; trimesh continues without some files
        self.missing: list[str] = []
        self.files = [path]  # that were read

    def get(self, name: str) -> bytes:
        """The file of that name, which may be percent-encoded, follow options or have backslashes.

        Raises OSError for a name outside of the folder, and a file that is missing.
        """
        folder = Path(self.parent).resolve()
        names = dict.fromkeys([name, unquote(name), OPTIONS.sub("", name.strip(), count=1).replace("\\", "/")])
        if not all((folder / each.strip()).resolve().is_relative_to(folder) for each in names):
            self.outside.append(name)
            raise FileNotFoundError(name)
        for each in names:
            try:
                content = super().get(each)
            except OSError:
                continue
            self.files.append(folder / each.strip())
            return bytes(content)
        self.missing.append(name)
        raise FileNotFoundError(name)


def unit_values(image: Any) -> Array:
    """An image as values (H, W, 3) in [0, 1]."""
    if image.mode.startswith("I"):  # grey of 16 bits, which Pillow would clip to 8
        return np.repeat(np.asarray(image, np.float64)[..., None] / 65535, 3, axis=2)
    return np.asarray(image.convert("RGB"), np.float64) / 255


def linear_image(image: Any) -> Array:
    return srgb_to_linear(unit_values(image))


def texture(values: Array) -> Bsdf:
    """A bitmap of linear values (H, W, C) with its first row at v = 1, as in all of these formats."""
    return {"type": "bitmap", "data": np.ascontiguousarray(values[::-1], np.float32), "raw": True}


def stored_texture(image: Any, raw: bool) -> Bsdf:
    """The texture of an image as it is, in a tenth of the memory: sRGB, or `raw` values."""
    if image.mode.startswith("I"):
        return texture(unit_values(image) if raw else linear_image(image))
    return {"type": "bitmap", "bitmap": np.ascontiguousarray(np.asarray(image.convert("RGB"))[::-1]), "raw": raw}


def two_sided(colour: Bsdf) -> Bsdf:
    return {"type": "twosided", "bsdf": diffuse_bsdf(colour)}


def check_mesh(mesh: trimesh.Trimesh, name: str, path: Path) -> None:
    """Raise BadInput for a mesh without faces, with faces that lack vertices, or vertices too far or not finite."""
    if not len(mesh.faces) or not np.abs(mesh.vertices).max() < MAX_EXTENT:
        raise BadInput(f"{path}: mesh '{name}' is empty or damaged: it has no faces or non-finite vertices")
    if not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise BadInput(f"{path}: mesh '{name}' is damaged: it lacks vertices of its faces; export it again")


def computed_normals(mesh: trimesh.Trimesh) -> Array:
    """Vertex normals (N, 3) by the faces around each vertex; where these cancel out, of one of them."""
    normals = np.zeros(mesh.vertices.shape)
    sound = mesh.face_normals.any(axis=1)
    normals[mesh.faces[sound]] = mesh.face_normals[sound, None]
    means = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).vertex_normals
    return np.where(np.linalg.norm(means, axis=1, keepdims=True) > 0.5, means, normals)


def mended(shape: Shape, notes: list[str]) -> Shape:
    """The shape with what of its mesh would make pixels NaN replaced, and a note."""
    mesh, uv = shape.mesh, getattr(shape.mesh.visual, "uv", None)
    if shape.smooth and (bad := without_direction(mesh.vertex_normals)).any():
        computed = computed_normals(mesh)
        normals = np.where(bad[:, None], computed, mesh.vertex_normals)
        mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=normals, visual=mesh.visual, process=False)
        if computed[bad].any():  # else no visible face has these
            notes.append(f"{shape.name}: {BAD_NORMALS}")
    if uv is not None and not np.isfinite(uv).all():
        mesh.visual = TextureVisuals(uv=np.nan_to_num(uv, posinf=0, neginf=0))
        notes.append(f"{shape.name}: {BAD_COORDINATES}")
    return replace(shape, mesh=mesh)
