"""Meshes of other programs, glTF, OBJ and PLY, with their materials, lit by themselves or by a sky."""

import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.resolvers import FilePathResolver
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from errors import BadInput
from scenes.animation import Camera, Shape, Track
from scenes.bsdf import Bsdf, diffuse_bsdf, rgb
from scenes.camera import Array
from scenes.names import Names
from scenes.sky import sky

FORMATS = (".glb", ".gltf", ".obj", ".ply")
GREY = rgb([0.5, 0.5, 0.5])
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

    def get(self, name: str) -> bytes:
        """Raises BadInput where the name leaves the folder."""
        folder = Path(self.parent).resolve()
        if not (folder / name.strip()).resolve().is_relative_to(folder):
            raise BadInput(f"{folder}: '{name}' leaves the scene's folder: move it into that folder")
        return super().get(name)


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
        return simple_bsdf(material), None
    if isinstance(mesh.visual, ColorVisuals) and mesh.visual.kind in ("vertex", "face"):
        colour = colour_factor(np.asarray(mesh.visual.main_color))
        notes.append(f"{name}: colours of its {mesh.visual.kind}s: the most frequent one everywhere instead")
        return {"type": "twosided", "bsdf": diffuse_bsdf(rgb(colour.tolist()))}, None
    notes.append(f"{name}: has no material: grey instead")
    return {"type": "twosided", "bsdf": diffuse_bsdf(GREY)}, None


def shape_of(mesh: trimesh.Trimesh, name: str, notes: list[str]) -> Shape:
    """Raises BadInput for a mesh that is damaged or empty."""
    if not len(mesh.faces) or not np.isfinite(mesh.vertices).all():
        raise BadInput(f"mesh '{name}' is empty or damaged: it has no faces, or vertices that are not finite")
    bsdf, radiance = bsdf_of(mesh, name, notes)
    if not isinstance(mesh.visual, TextureVisuals):
        mesh.visual = TextureVisuals()
    return Shape(name, mesh, bsdf, None if radiance is None else Track.constant(radiance), smooth=True)


def load_scene(path: Path) -> trimesh.Scene:
    """Raises BadInput, naming the file, where it is missing, of another format or damaged."""
    if path.suffix.lower() not in FORMATS:
        raise BadInput(f"{path} is no scene file: Mitsuba's .xml, or one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise BadInput(f"{path} is missing")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return trimesh.load_scene(path, resolver=InsideResolver(str(path)), process=False)
    except BadInput:
        raise
    except Exception as error:  # of whatever kind its many readers raise for a file that is damaged
        raise BadInput(f"{path} is empty or damaged: {error}") from None


def camera_of(scene: trimesh.Scene) -> Camera | None:
    """The file's camera at rest, which looks along its -z; None where it has none."""
    if not scene.has_camera:
        return None
    pose = np.asarray(scene.camera_transform, np.float64)
    eye = pose[:3, 3]
    x_fov = Track.constant(float(scene.camera.fov[0]))
    return Camera(Track.constant(eye), Track.constant(eye - pose[:3, 2]), x_fov, Track.constant(pose[:3, 1]))


def load_mesh_file(path: Path) -> MeshFile:
    """All meshes of a file, where its scene puts them. Under a clear sky where nothing shines.

    Raises BadInput, naming the file, where it is missing, damaged or empty.
    """
    scene = load_scene(path)
    found = MeshFile(camera=camera_of(scene))
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
        found.shapes.append(shape_of(mesh, name, found.notes))
    if not found.shapes:
        raise BadInput("; ".join([f"{path} has no mesh to render", *found.notes]))
    if not any(shape.radiance for shape in found.shapes):
        found.notes.append("nothing shines: a clear sky with the sun, y up")
        found.sky = sky(np.random.default_rng(0), SUN)
    return found
