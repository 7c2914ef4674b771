"""What readers of mesh files share: the files that these refer to, images as textures, and checks of meshes."""

import re
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver

from errors import BadInput
from render.loading import MAX_EXTENT
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


def two_sided(colour: Bsdf) -> Bsdf:
    return {"type": "twosided", "bsdf": diffuse_bsdf(colour)}


def check_mesh(mesh: trimesh.Trimesh, name: str, path: Path) -> None:
    """Raise BadInput for a mesh without faces, or with vertices that are not finite or too far away."""
    if not len(mesh.faces) or not np.abs(mesh.vertices).max() < MAX_EXTENT:
        raise BadInput(f"{path}: mesh '{name}' is empty or damaged: it has no faces or non-finite vertices")
