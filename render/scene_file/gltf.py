"""glTF 2.0: its meshes in world space, their emission, and its camera."""

import base64
import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.transformations import quaternion_matrix
from trimesh.visual import TextureVisuals

from errors import BadInput
from render.scene_file.assets import InsideResolver, check_mesh, mended, two_sided
from render.scene_file.gltf_materials import UNTINTED, Colour, GltfMaterials, coordinate_set
from render.scene_file.stand_ins import GREY, Names
from scenes.animation import Camera, Shape, Track
from scenes.camera import Y_UP, Array, up_of
from scenes.colours import rgb

COMPONENT_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
COMPONENT_COUNTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
HONOURED = {
    "EXT_texture_webp",
    "KHR_materials_emissive_strength",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
HARMLESS = ("KHR_materials_", "KHR_lights_punctual")  # beginnings of names: without them the shapes are the same
THINNESS = 1e-5  # the distance between both sides of a lamp, over the extent of the scene: more than float32 blurs


def content_of(path: Path) -> tuple[dict[str, Any], bytes]:
    """The JSON, and the binary chunk of a .glb."""
    content = path.read_bytes()
    if content[:4] != b"glTF":
        return dict(json.loads(content)), b""
    end = 20 + int.from_bytes(content[12:16], "little")
    return dict(json.loads(content[20:end])), content[end + 8 :]


def local_matrix(node: dict[str, Any]) -> Array:
    """A node's transform (4, 4) to its parent (glTF 2.0, 3.5.3)."""
    if "matrix" in node:
        return np.reshape(node["matrix"], (4, 4)).T.astype(np.float64)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix = quaternion_matrix([w, x, y, z]) @ np.diag([*node.get("scale", (1.0, 1.0, 1.0)), 1.0])
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return np.asarray(matrix, np.float64)


def world_matrices(nodes: list[dict[str, Any]], roots: list[int]) -> dict[int, Array]:
    """The transforms to world space of the nodes under `roots`, by index, depth first in the file's order."""
    found: dict[int, Array] = {}
    waiting = [(root, np.eye(4)) for root in reversed(roots)]
    while waiting:
        index, parent = waiting.pop()
        if index not in found:  # a damaged file may have a circle
            found[index] = parent @ local_matrix(nodes[index])
            waiting += [(child, found[index]) for child in reversed(nodes[index].get("children", []))]
    return found


def parentless(nodes: list[dict[str, Any]]) -> list[int]:
    children = {child for node in nodes for child in node.get("children", [])}
    return [index for index in range(len(nodes)) if index not in children]


def faces_of(indices: NDArray[Any], mode: int) -> NDArray[Any]:
    """Triangles (F, 3) of a list (mode 4), a strip (5) or a fan (6)."""
    if mode == 4:
        return indices.reshape(-1, 3)
    first = indices[:-2] if mode == 5 else np.broadcast_to(indices[:1], len(indices) - 2)
    faces = np.stack([first, indices[1:-1], indices[2:]], axis=1)
    if mode == 5:  # every second triangle of a strip is wound the other way
        faces[1::2] = faces[1::2, [0, 2, 1]]
    return faces


def with_both_sides(mesh: trimesh.Trimesh, distance: float) -> trimesh.Trimesh:
    """The mesh and a reversed copy behind it: Mitsuba's lamps shine to the front alone.

    At no distance, rays would hit either of them.
    """
    normals, uv = mesh.vertex_normals, getattr(mesh.visual, "uv", None)
    both = trimesh.Trimesh(
        np.vstack([mesh.vertices, mesh.vertices - distance * normals]),
        np.vstack([mesh.faces, mesh.faces[:, ::-1] + len(mesh.vertices)]),
        vertex_normals=np.vstack([normals, -normals]),
        process=False,
    )
    both.visual = TextureVisuals(uv=None if uv is None else np.vstack([uv, uv]))
    return both


class GltfFile:
    """The shapes of a file's scene; `notes` list what is not honoured.

    Raises BadInput, naming the file, for what it lacks or requires; other exceptions are damage.
    """

    def __init__(self, path: Path, resolver: InsideResolver):
        self.path = path
        self.resolver = resolver
        self.json, self.binary = content_of(path)
        self.nodes: list[dict[str, Any]] = self.json.get("nodes", [])
        self.notes: list[str] = []
        self.read_extensions()
        self.buffer = cache(self.read_buffer)
        self.materials = GltfMaterials(self.json, self.content, self.notes)
        self.names = Names()
        self.shapes: list[Shape] = []
        self.two_sided_lamps: list[int] = []  # indices of shapes
        scenes = self.json.get("scenes")
        roots = scenes[self.json.get("scene", 0)].get("nodes", []) if scenes else parentless(self.nodes)
        for index, to_world in world_matrices(self.nodes, roots).items():
            if "mesh" in self.nodes[index]:
                self.add_meshes(self.nodes[index], to_world)
        extent = max((np.abs(shape.mesh.vertices).max() for shape in self.shapes), default=1.0)
        for index in self.two_sided_lamps:
            shape = self.shapes[index]
            self.shapes[index] = replace(shape, mesh=with_both_sides(shape.mesh, THINNESS * extent))

    def read_extensions(self) -> None:
        """Note what is left out, and raise BadInput for what the file cannot be read without."""
        for name in self.json.get("extensionsRequired", []):
            if name not in HONOURED and not name.startswith(HARMLESS):
                raise BadInput(f"{self.path} requires the extension {name}, which is not supported: export it without")
        unknown = [name for name in self.json.get("extensionsUsed", []) if name not in HONOURED]
        self.notes += [f"the extension {name} may not be honoured" for name in unknown]
        for what in ("animations", "skins"):
            if self.json.get(what):
                self.notes.append(f"its {what} are left out: meshes stay at rest")
        kinds = [camera.get("type") for camera in self.json.get("cameras", [])]
        if kinds.count("perspective") > 1:
            self.notes.append("it has several cameras: the first one is used")
        if "orthographic" in kinds:
            self.notes.append("orthographic cameras are left out")

    def read_buffer(self, index: int) -> bytes:
        described = self.json["buffers"][index]
        if index == 0 and self.binary and "uri" not in described:
            return self.binary
        return self.content(described)

    def content(self, described: dict[str, Any]) -> bytes:
        """The content of a buffer or an image."""
        if "bufferView" in described:
            view = self.json["bufferViews"][described["bufferView"]]
            start = view.get("byteOffset", 0)
            return self.buffer(view["buffer"])[start : start + view["byteLength"]]
        uri = described["uri"]
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(",")[2])
        return self.resolver.get(uri)

    def items(self, described: dict[str, Any], count: int, kind: np.dtype[Any], width: int) -> NDArray[Any]:
        """The values (count, width) of an accessor, or of a part of a sparse one."""
        view = self.json["bufferViews"][described["bufferView"]]
        start = view.get("byteOffset", 0) + described.get("byteOffset", 0)
        strides = (view.get("byteStride") or kind.itemsize * width, kind.itemsize)
        return np.ndarray((count, width), kind, self.buffer(view["buffer"]), start, strides)  # raises out of bounds

    def values(self, index: int) -> NDArray[Any]:
        """The values (N, C) of an accessor, in [-1, 1] if they are normalised."""
        accessor = self.json["accessors"][index]
        shape = accessor["count"], COMPONENT_COUNTS[accessor["type"]]
        kind = np.dtype(COMPONENT_TYPES[accessor["componentType"]])
        sparse = accessor.get("sparse")
        if "bufferView" in accessor:
            values = self.items(accessor, shape[0], kind, shape[1])
        elif sparse is not None:
            values = np.zeros(shape, kind)
        else:
            raise BadInput(f"{self.path}: a mesh has no data, or compressed data alone: export it without compression")
        if sparse is not None:
            indices = np.dtype(COMPONENT_TYPES[sparse["indices"]["componentType"]])
            changed = self.items(sparse["indices"], sparse["count"], indices, 1)[:, 0]
            values = values.copy()
            values[changed] = self.items(sparse["values"], sparse["count"], kind, shape[1])
        normalised = accessor.get("normalized") and kind.kind != "f"
        return np.maximum(values / np.iinfo(kind).max, -1) if normalised else values

    def add_meshes(self, node: dict[str, Any], to_world: Array) -> None:
        """Add the shapes of a node: one for each material, named after the node and, if there are several, that."""
        mesh = self.json["meshes"][node["mesh"]]
        if any(node.get("weights", mesh.get("weights", []))):
            self.notes.append(f"{node.get('name', 'mesh')}: its morph targets are left out")
        for primitive in mesh["primitives"]:
            name = str(node.get("name") or mesh.get("name") or "mesh")
            if len(mesh["primitives"]) > 1 and "material" in primitive:
                name += f"_{self.materials.name(primitive['material'])}"
            name = self.names.unique(name)
            if primitive.get("mode", 4) not in (4, 5, 6) or "POSITION" not in primitive["attributes"]:
                self.notes.append(f"{name}: points or lines, no mesh: left out")
            else:
                self.add_shape(name, primitive, to_world)

    def add_shape(self, name: str, primitive: dict[str, Any], to_world: Array) -> None:
        attributes = primitive["attributes"]
        vertices = self.values(attributes["POSITION"])
        indices = self.values(primitive["indices"])[:, 0] if "indices" in primitive else np.arange(len(vertices))
        normals = self.values(attributes["NORMAL"]) if "NORMAL" in attributes else None
        faces = faces_of(indices.astype(np.int64), primitive.get("mode", 4))
        if len(faces) and faces.max() >= len(vertices):
            raise BadInput(f"{self.path}: mesh '{name}' is damaged: it lacks vertices of its faces")
        mesh = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
        mesh.apply_transform(to_world)
        check_mesh(mesh, name, self.path)
        tint = self.tint(name, attributes)
        mesh.visual = TextureVisuals()
        bsdf, emission = two_sided(GREY if tint is None else rgb(tint)), None
        if "material" in primitive:
            number = primitive["material"]
            bsdf = self.materials.bsdf(number, tint or UNTINTED)
            infos = self.materials.textures(number)
            mesh.visual.uv = self.coordinates(attributes, infos[0] if infos else {})
            radiance = self.materials.radiance(name, number, mesh, lambda info: self.coordinates(attributes, info))
            emission = Track.constant(radiance) if radiance.any() else None
            if emission and self.json["materials"][number].get("doubleSided"):
                self.two_sided_lamps.append(len(self.shapes))
        elif tint is None:
            self.notes.append(f"{name}: has no material: grey instead")
        # By the specification, a mesh without normals has flat faces.
        self.shapes.append(mended(Shape(name, mesh, bsdf, emission, smooth=normals is not None), self.notes))

    def coordinates(self, attributes: dict[str, int], info: dict[str, Any]) -> Array | None:
        """The texture coordinates (N, 2), with v upwards, that a reference to a texture is for; None for none."""
        index = attributes.get(f"TEXCOORD_{coordinate_set(info)}")
        return None if index is None else self.values(index) * (1.0, -1.0) + (0.0, 1.0)

    def tint(self, name: str, attributes: dict[str, int]) -> Colour | None:
        """The most frequent colour of a mesh's vertices; None if they have none."""
        if "COLOR_0" not in attributes:
            return None
        colours, counts = np.unique(self.values(attributes["COLOR_0"])[:, :3], axis=0, return_counts=True)
        if len(colours) > 1:
            self.notes.append(f"{name}: colours of its vertices: the most frequent one everywhere instead")
        return tuple(colours[counts.argmax()].tolist())

    def camera(self, aspect: float) -> Camera | None:
        """The first perspective camera, which looks along its -z, with its vertical field of view for that `aspect`.

        Raises KeyError, IndexError, TypeError or ValueError for damage.
        """
        for index, pose in sorted(world_matrices(self.nodes, parentless(self.nodes)).items()):
            camera = self.json["cameras"][self.nodes[index]["camera"]] if "camera" in self.nodes[index] else {}
            if camera.get("type") == "perspective":
                axes = pose[:3, :3] / np.linalg.norm(pose[:3, :3], axis=0)
                x_fov = np.degrees(2 * np.arctan(aspect * np.tan(camera["perspective"]["yfov"] / 2)))
                if not np.isfinite([*pose.ravel(), *axes.ravel(), x_fov]).all():
                    raise ValueError("not finite")
                return Camera.at_rest(pose[:3, 3], pose[:3, 3] - axes[:, 2], float(x_fov), up_of(axes, Y_UP))
        return None
