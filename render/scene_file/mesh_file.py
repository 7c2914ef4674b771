"""glTF, OBJ and PLY files with their materials, lit by their own emission or by a sky."""

import json
import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver
from trimesh.transformations import quaternion_matrix
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from errors import BadInput, can_draw
from render.loading import MAX_EXTENT
from render.scene_file.stand_ins import GREY, Names
from scenes.animation import Camera, Shape, Track
from scenes.camera import Array
from scenes.colours import Bsdf, diffuse_bsdf, rgb, srgb_to_linear
from scenes.textures import sky

GLTF_FORMATS = (".glb", ".gltf")
FORMATS = (*GLTF_FORMATS, ".obj", ".ply")
SUN = np.array([0.4, 0.8, 0.45])  # the direction to it, y up


class InsideResolver(FilePathResolver):
    """Reads the files that a mesh file refers to, from its own folder only."""

    def __init__(self, path: Path):
        super().__init__(str(path))
        self.outside: list[str] = []  # names outside of the folder; trimesh continues without some files
        self.missing: list[str] = []

    def get(self, name: str) -> bytes:
        """Raises OSError for a name outside of the folder, and a file that is missing."""
        folder = Path(self.parent).resolve()
        if not (folder / name.strip()).resolve().is_relative_to(folder):
            self.outside.append(name)
            raise FileNotFoundError(name)
        try:
            return super().get(name)
        except OSError:
            self.missing.append(name)
            raise


@contextmanager
def collected_problems() -> Iterator[list[str]]:
    """Within the context trimesh prints nothing, and its messages on what it could not read are collected."""
    log = logging.getLogger("trimesh")
    level, propagate = log.level, log.propagate
    problems: list[str] = []

    def collect(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        if record.levelno >= logging.WARNING or re.match("unable to|failed to|skipping|face|specified", message):
            problems.append(f"trimesh: {message[:200]}")
        return False

    handler = logging.Handler()
    handler.addFilter(collect)
    log.addHandler(handler)
    log.setLevel(logging.DEBUG)
    log.propagate = False
    try:
        yield problems
    finally:
        log.removeHandler(handler)
        log.setLevel(level)
        log.propagate = propagate


def unit_values(image: Any) -> Array:
    """An image as values (H, W, 3) in [0, 1]."""
    return np.asarray(image.convert("RGB"), np.float64) / 255


def linear_image(image: Any) -> Array:
    return srgb_to_linear(unit_values(image))


def texture(values: Array) -> Bsdf:
    """A bitmap of linear values (H, W, C) with its first row at v = 1, as in all of these formats."""
    return {"type": "bitmap", "data": np.ascontiguousarray(values[::-1], np.float32), "raw": True}


def two_sided(colour: Bsdf) -> Bsdf:
    return {"type": "twosided", "bsdf": diffuse_bsdf(colour)}


def colour_factor(value: Any) -> Array:
    """The first three components of a colour, given in [0, 1] or as bytes; white for none."""
    if value is None:
        return np.ones(3)
    value = np.asarray(value)
    return value[:3] / 255 if value.dtype == np.uint8 else value[:3].astype(np.float64)


def pbr_bsdf(material: PBRMaterial) -> Bsdf:
    """glTF's metallic-roughness material as Mitsuba's principled one."""
    roughness: Any = 1.0 if material.roughnessFactor is None else float(material.roughnessFactor)
    metallic: Any = 1.0 if material.metallicFactor is None else float(material.metallicFactor)
    if material.metallicRoughnessTexture is not None:
        channels = unit_values(material.metallicRoughnessTexture)
        roughness = texture(channels[..., 1:2] * roughness)
        metallic = texture(channels[..., 2:3] * metallic)
    factor, image = colour_factor(material.baseColorFactor), material.baseColorTexture
    colour = rgb(factor.tolist()) if image is None else texture(linear_image(image) * factor)
    bsdf: Bsdf = {"type": "principled", "base_color": colour, "roughness": roughness, "metallic": metallic}
    bsdf |= {"specular": 0.5}
    if material.normalTexture is not None:
        bsdf = {"type": "normalmap", "normalmap": texture(unit_values(material.normalTexture)), "bsdf": bsdf}
    return {"type": "twosided", "bsdf": bsdf}


# Keywords of an OBJ's materials: the property that is left out, and the value that stands for none.
LEFT_OUT: dict[str, tuple[str, list[float]]] = {
    "ks": ("gloss", [0.0, 0.0, 0.0]),
    "d": ("transparency", [1.0]),
    "tr": ("transparency", [0.0]),
    "map_d": ("transparency", []),
    "map_bump": ("relief", []),
    "bump": ("relief", []),
    "map_ke": ("light", []),
}


def plain_numbers(words: Any) -> list[float]:
    """The numbers in a line of a material; NaN if they are malformed."""
    try:
        return [float(word) for word in words]
    except (TypeError, ValueError):
        return [np.nan]


def bsdf_of(mesh: trimesh.Trimesh, name: str, notes: list[str]) -> tuple[Bsdf, Array | None]:
    """(material, emitted radiance or None) of a mesh."""
    material = getattr(mesh.visual, "material", None)
    if isinstance(material, PBRMaterial):
        if material.alphaMode not in (None, "OPAQUE"):
            notes.append(f"{name}: transparency is left out: opaque instead")
        if material.emissiveTexture is not None:
            notes.append(f"{name}: an emissive texture: uniform emission instead")
        emission = None if material.emissiveFactor is None else np.asarray(material.emissiveFactor, np.float64)
        return pbr_bsdf(material), emission if emission is not None and emission.any() else None
    if isinstance(material, SimpleMaterial):
        lines = material.kwargs
        for key, (what, none) in LEFT_OUT.items():
            if key in lines and plain_numbers(lines[key]) != none:
                notes.append(f"{name}: its {what} ({key}) is left out")
        emission = np.array(plain_numbers(lines.get("ke", [])))
        image = getattr(material, "image", None)
        colour = rgb(colour_factor(material.diffuse).tolist()) if image is None else texture(linear_image(image))
        return two_sided(colour), emission if emission.shape == (3,) and emission.any() else None
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind in ("vertex", "face"):
        places = {"vertex": "vertices", "face": "faces"}[mesh.visual.kind]
        notes.append(f"{name}: colours of its {places}: the most frequent one everywhere instead")
        return two_sided(rgb(colour_factor(np.asarray(mesh.visual.main_color)).tolist())), None
    notes.append(f"{name}: has no material: grey instead")
    return two_sided(GREY), None


def load_scene(path: Path) -> tuple[trimesh.Scene, dict[str, Any], list[str]]:
    """A file's scene, the JSON of a glTF, and notes.

    Raises BadInput, naming the file, if it is missing, damaged, of another format, or refers to files elsewhere.
    """
    if path.suffix.lower() not in FORMATS:
        raise BadInput(f"{path} is no scene file: Mitsuba's .xml, or one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise BadInput(f"{path} is missing")
    resolver = InsideResolver(path)
    scene = None
    damage = ""
    try:
        with warnings.catch_warnings(action="ignore"), collected_problems() as problems:
            scene = trimesh.load_scene(path, resolver=resolver, process=False)
    except Exception as error:  # its readers raise many kinds of exceptions for damaged files
        damage = " ".join(f"{type(error).__name__}: {error}"[:200].split())
    if resolver.outside:
        raise BadInput(f"{path}: '{resolver.outside[0]}' leaves the scene's folder: move it into that folder")
    if scene is None:
        missing = f": {resolver.missing[0]} is missing" if resolver.missing else f" is empty or damaged ({damage})"
        raise BadInput(f"{path}{missing}")
    gltf = gltf_of(path)
    notes = [f"the file {name} is missing: its content is left out" for name in dict.fromkeys(resolver.missing)]
    notes += [*dict.fromkeys(problems), *notes_of_gltf(gltf)]
    if not can_draw():
        notes.append("textures are left out: reading them needs `pip install 'onespp[report]'`")
    return scene, gltf, notes


def gltf_of(path: Path) -> dict[str, Any]:
    """The JSON of a glTF; empty for other formats."""
    if path.suffix.lower() not in GLTF_FORMATS:
        return {}
    content = path.read_bytes()
    if content[:4] == b"glTF":
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    return dict(json.loads(content))


def notes_of_gltf(gltf: dict[str, Any]) -> list[str]:
    """Notes on its content beyond meshes, materials and a perspective camera."""
    notes = [f"its {what} are left out: meshes stay at rest" for what in ("animations", "skins") if gltf.get(what)]
    notes += [f"the extension {name} may not be honoured" for name in gltf.get("extensionsUsed", [])]
    kinds = [camera.get("type") for camera in gltf.get("cameras", [])]
    if kinds.count("perspective") > 1:
        notes.append("it has several cameras: the first one is used")
    if "orthographic" in kinds:
        notes.append("orthographic cameras are left out")
    return notes


def local_matrix(node: dict[str, Any]) -> Array:
    """A glTF node's transform (4, 4) to its parent (glTF 2.0, 3.5.3)."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(np.float64)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = quaternion_matrix([w, x, y, z]) @ np.diag([*node.get("scale", (1.0, 1.0, 1.0)), 1.0])
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return np.asarray(matrix, np.float64)


def camera_of_gltf(gltf: dict[str, Any], aspect: float) -> Camera | None:
    """Its first perspective camera, which looks along its -z, with its vertical field of view for that `aspect`.

    Trimesh neither follows the parents of cameras nor reads those without an aspect ratio.
    """
    nodes = gltf.get("nodes", [])
    parents = {child: index for index, node in enumerate(nodes) for child in node.get("children", [])}
    for index, node in enumerate(nodes):
        camera = gltf["cameras"][node["camera"]] if "camera" in node else {}
        if camera.get("type") != "perspective":
            continue
        chain = [index]
        while chain[-1] in parents and len(chain) < len(nodes):  # a damaged file may have a circle
            chain.append(parents[chain[-1]])
        pose = reduce(np.matmul, [local_matrix(nodes[each]) for each in reversed(chain)])
        axes = pose[:3, :3] / np.linalg.norm(pose[:3, :3], axis=0)
        x_fov = np.degrees(2 * np.arctan(aspect * np.tan(camera["perspective"]["yfov"] / 2)))
        return Camera.at_rest(pose[:3, 3], pose[:3, 3] - axes[:, 2], float(x_fov), axes[:, 1])
    return None


class MeshFile:
    """All meshes of a file, and its camera for images of an `aspect` (width over height); a clear sky if unlit.

    `notes` list what is not honoured. Raises BadInput, naming the file, if it is missing, damaged or empty.
    """

    def __init__(self, path: Path, aspect: float):
        scene, gltf, self.notes = load_scene(path)
        try:
            self.camera = camera_of_gltf(gltf, aspect)
        except (KeyError, IndexError, TypeError, ValueError):
            self.camera = None
            self.notes.append("its cameras are damaged: left out")
        self.shapes: list[Shape] = []
        self.sky: Array | None = None
        names = Names()
        for node in scene.graph.nodes_geometry:
            transform, geometry = scene.graph[node]
            mesh = scene.geometry[geometry]
            name = names.unique(str(node))
            if not isinstance(mesh, trimesh.Trimesh):
                self.notes.append(f"{name}: no mesh, but a {type(mesh).__name__}: left out")
                continue
            mesh = mesh.copy(include_cache=True)
            mesh.apply_transform(transform)
            if not len(mesh.faces) or not np.abs(mesh.vertices).max() < MAX_EXTENT:
                raise BadInput(f"{path}: mesh '{name}' is empty or damaged: it has no faces or non-finite vertices")
            bsdf, radiance = bsdf_of(mesh, name, self.notes)
            if not isinstance(mesh.visual, TextureVisuals):
                mesh.visual = TextureVisuals()
            emission = None if radiance is None else Track.constant(radiance)
            # By its specification, a glTF mesh without normals has flat faces.
            smooth = path.suffix.lower() not in GLTF_FORMATS or "vertex_normals" in mesh._cache
            self.shapes.append(Shape(name, mesh, bsdf, emission, smooth=smooth))
        if not self.shapes:
            raise BadInput("; ".join([f"{path} has no mesh to render", *self.notes]))
        if not any(shape.radiance for shape in self.shapes):
            self.notes.append("there is no light: a clear sky with the sun, y up")
            self.sky = sky(np.random.default_rng(0), SUN)
