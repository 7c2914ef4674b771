"""Meshes of other programs, glTF, OBJ and PLY, with their materials, lit by themselves or by a sky."""

import json
import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from errors import BadInput
from extras import can_draw
from scenes.animation import Camera, Shape, Track
from scenes.bsdf import Bsdf, diffuse_bsdf, rgb
from scenes.camera import Array
from scenes.names import Names
from scenes.sky import sky

FORMATS = (".glb", ".gltf", ".obj", ".ply")
GREY = rgb([0.5, 0.5, 0.5])
LARGEST = 1e18  # units from the origin: its square is a finite float32
SUN = np.array([0.4, 0.8, 0.45])  # the direction to it, y up


@dataclass
class MeshFile:
    """What a file of meshes holds; `notes` say what is not honoured, and what stands in for it."""

    shapes: list[Shape] = field(default_factory=list)
    camera: Camera | None = None
    sky: Array | None = None
    notes: list[str] = field(default_factory=list)


class InsideResolver(FilePathResolver):
    """Reads what a file of meshes refers to, from its own folder alone."""

    def __init__(self, path: Path):
        super().__init__(str(path))
        self.strangers: list[str] = []  # names that leave the folder; trimesh goes on without some files
        self.missing: list[str] = []

    def get(self, name: str) -> bytes:
        """Raises OSError for a name that leaves the folder, and a file that is missing."""
        folder = Path(self.parent).resolve()
        if not (folder / name.strip()).resolve().is_relative_to(folder):
            self.strangers.append(name)
            raise FileNotFoundError(name)
        try:
            return super().get(name)
        except OSError:
            self.missing.append(name)
            raise


class Complaints(logging.Handler):
    """What trimesh could not do, and logs for its makers only."""

    def __init__(self) -> None:
        super().__init__()
        self.heard: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Called by trimesh for each message."""
        said = record.getMessage()
        if record.levelno >= logging.WARNING or re.match("unable to|failed to|skipping|face|specified", said):
            self.heard.append(f"trimesh: {said[:200]}")


@contextmanager
def overheard() -> Iterator[Complaints]:
    """While trimesh's complaints are kept, and not printed."""
    log = logging.getLogger("trimesh")
    before = log.level, log.propagate
    complaints = Complaints()
    log.addHandler(complaints)
    log.setLevel(logging.DEBUG)
    log.propagate = False
    try:
        yield complaints
    finally:
        log.removeHandler(complaints)
        log.setLevel(before[0])
        log.propagate = before[1]


def linear(image: Any) -> Array:
    """A picture as linear values (H, W, C): its sRGB curve is undone."""
    encoded = np.asarray(image.convert("RGB"), np.float64) / 255
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def texture(values: Array) -> Bsdf:
    """A bitmap of linear values (H, W, C), whose first row belongs to v = 1, as in all of these formats."""
    return {"type": "bitmap", "data": np.ascontiguousarray(values[::-1], np.float32), "raw": True}


def times_factor(image: Any, factor: Array) -> Bsdf:
    """A colour: a factor (3,), times a picture where there is one."""
    return rgb(factor.tolist()) if image is None else texture(linear(image) * factor)


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
        channels = np.asarray(material.metallicRoughnessTexture.convert("RGB"), np.float64) / 255
        roughness = texture(channels[..., 1:2] * roughness)
        metallic = texture(channels[..., 2:3] * metallic)
    colour = times_factor(material.baseColorTexture, colour_factor(material.baseColorFactor))
    bsdf: Bsdf = {"type": "principled", "base_color": colour, "roughness": roughness, "metallic": metallic}
    bsdf = {"type": "twosided", "bsdf": bsdf | {"specular": 0.5}}
    if material.normalTexture is not None:
        normals = np.asarray(material.normalTexture.convert("RGB"), np.float64) / 255
        bsdf = {"type": "normalmap", "normalmap": texture(normals), "bsdf": bsdf["bsdf"]}
        bsdf = {"type": "twosided", "bsdf": bsdf}
    return bsdf


def simple_bsdf(material: SimpleMaterial) -> Bsdf:
    """The diffuse colour of an OBJ's material."""
    image = getattr(material, "image", None)
    colour = texture(linear(image)) if image is not None else rgb(colour_factor(material.diffuse).tolist())
    return {"type": "twosided", "bsdf": diffuse_bsdf(colour)}


# Of an OBJ's materials: by keyword what it means, and what it says where there is nothing of the kind.
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
    """The numbers that a line of a material has; none where they are no numbers."""
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
            notes.append(f"{name}: an emissive texture: it shines evenly instead")
        shines = None if material.emissiveFactor is None else np.asarray(material.emissiveFactor, np.float64)
        return pbr_bsdf(material), shines if shines is not None and shines.any() else None
    if isinstance(material, SimpleMaterial):
        said = material.kwargs
        for key, (what, none) in LEFT_OUT.items():
            if key in said and plain_numbers(said[key]) != none:
                notes.append(f"{name}: its {what} ({key}) is left out")
        shines = np.array(plain_numbers(said.get("ke", [])))
        return simple_bsdf(material), shines if shines.shape == (3,) and shines.any() else None
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind in ("vertex", "face"):
        colour = colour_factor(np.asarray(mesh.visual.main_color))
        places = {"vertex": "vertices", "face": "faces"}[mesh.visual.kind]
        notes.append(f"{name}: colours of its {places}: the most frequent one everywhere instead")
        return {"type": "twosided", "bsdf": diffuse_bsdf(rgb(colour.tolist()))}, None
    notes.append(f"{name}: has no material: grey instead")
    return {"type": "twosided", "bsdf": diffuse_bsdf(GREY)}, None


def shape_of(mesh: trimesh.Trimesh, name: str, notes: list[str]) -> Shape:
    """The mesh with its material and light."""
    bsdf, radiance = bsdf_of(mesh, name, notes)
    if not isinstance(mesh.visual, TextureVisuals):
        mesh.visual = TextureVisuals()
    return Shape(name, mesh, bsdf, None if radiance is None else Track.constant(radiance), smooth=True)


def load_scene(path: Path) -> tuple[trimesh.Scene, list[str]]:
    """A file's scene, and what is not honoured.

    Raises BadInput, naming the file, where it is missing, of another format or damaged, or where it leaves its folder.
    """
    if path.suffix.lower() not in FORMATS:
        raise BadInput(f"{path} is no scene file: Mitsuba's .xml, or one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise BadInput(f"{path} is missing")
    resolver = InsideResolver(path)
    scene = None
    damage = ""
    try:
        with warnings.catch_warnings(), overheard() as complaints:
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(path, resolver=resolver, process=False)
    except Exception as error:  # of whatever kind its many readers raise for a file that is damaged
        damage = " ".join(f"{type(error).__name__}: {error}"[:200].split())
    if resolver.strangers:
        raise BadInput(f"{path}: '{resolver.strangers[0]}' leaves the scene's folder: move it into that folder")
    if scene is None:
        missing = f": {resolver.missing[0]} is missing" if resolver.missing else f" is empty or damaged ({damage})"
        raise BadInput(f"{path}{missing}")
    notes = [f"the file {name} is missing: what it says is left out" for name in dict.fromkeys(resolver.missing)]
    return scene, notes + list(dict.fromkeys(complaints.heard)) + notes_of_gltf(path) + notes_of_textures()


def notes_of_textures() -> list[str]:
    return [] if can_draw() else ["textures are left out: reading them needs `pip install 'onespp[report]'`"]


def notes_of_gltf(path: Path) -> list[str]:
    """What a glTF says beyond meshes, materials and a camera, in words; nothing of other formats."""
    if path.suffix.lower() not in (".glb", ".gltf"):
        return []
    content = path.read_bytes()
    if content[:4] == b"glTF":
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    said = json.loads(content)
    notes = [f"its {what} are left out: meshes stand as they are" for what in ("animations", "skins") if said.get(what)]
    notes += [f"the extension {name} may not be honoured" for name in said.get("extensionsUsed", [])]
    if len(said.get("cameras", [])) > 1:
        notes.append("it has several cameras: one is taken")
    return notes


def camera_of(scene: trimesh.Scene, aspect: float) -> Camera | None:
    """The file's camera at rest, which looks along its -z; None where it has none.

    Its field of view is the vertical one, as in glTF, of images `aspect` times as wide as high.
    """
    if not scene.has_camera:
        return None
    pose = np.asarray(scene.camera_transform, np.float64)
    eye = pose[:3, 3]
    x_fov = np.degrees(2 * np.arctan(aspect * np.tan(np.radians(scene.camera.fov[1]) / 2)))
    axes = pose[:3, :3] / np.linalg.norm(pose[:3, :3], axis=0)
    return Camera(
        Track.constant(eye), Track.constant(eye - axes[:, 2]), Track.constant(float(x_fov)), Track.constant(axes[:, 1])
    )


def load_mesh_file(path: Path, aspect: float) -> MeshFile:
    """All meshes of a file, where its scene puts them, for images of that `aspect`. Where nothing shines, a clear sky.

    Raises BadInput, naming the file, where it is missing, damaged or empty.
    """
    scene, notes = load_scene(path)
    found = MeshFile(camera=camera_of(scene, aspect), notes=notes)
    names = Names()
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        name = names.unique(str(node))
        if not isinstance(mesh, trimesh.Trimesh):
            found.notes.append(f"{name}: no mesh, but a {type(mesh).__name__}: left out")
            continue
        mesh = mesh.copy(include_cache=True)
        mesh.apply_transform(transform)
        if not len(mesh.faces) or not np.abs(mesh.vertices).max() < LARGEST:
            raise BadInput(
                f"{path}: mesh '{name}' is empty or damaged: it has no faces, or vertices that are not finite"
            )
        found.shapes.append(shape_of(mesh, name, found.notes))
    if not found.shapes:
        raise BadInput("; ".join([f"{path} has no mesh to render", *found.notes]))
    if not any(shape.radiance for shape in found.shapes):
        found.notes.append("nothing shines: a clear sky with the sun, y up")
        found.sky = sky(np.random.default_rng(0), SUN)
    return found
