"""Mitsuba objects from descriptions of shapes and lights."""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from trimesh.visual import TextureVisuals

from errors import BadInput
from render.backend import VARIANT, dr, mi
from scenes.animation import Shape, StockLight, StockShape
from scenes.camera import Array
from scenes.colours import Bsdf

ArrayT = TypeVar("ArrayT", bound=dr.AnyArray)
PLACE = "_place"  # where a file describes it: Mitsuba does not get keys that begin with _


def to_mitsuba(description: Mapping[str, Any], load: Callable[[Bsdf], object] | None = None) -> dict[str, Any]:
    """A Mitsuba dictionary with numpy arrays as Mitsuba's types. `load` makes objects of nested ones but colours."""

    def convert(key: str, value: Any) -> object:
        if isinstance(value, dict):
            return load(value) if load and value["type"] not in ("rgb", "spectrum") else to_mitsuba(value)
        if isinstance(value, np.ndarray) and value.shape == (4, 4):
            return mi.ScalarTransform4f(value)
        if key == "to_uv":
            return mi.ScalarTransform3f(value)
        if isinstance(value, np.ndarray) and value.dtype == np.uint8:
            return mi.Bitmap(value)
        if isinstance(value, np.ndarray):
            return mi.TensorXf(upload(np.float32(value).ravel()), value.shape)
        return value

    return {key: convert(key, value) for key, value in description.items() if not key.startswith("_")}


def without_placement(bsdf: Bsdf, placements: list[Array]) -> Bsdf:
    """The material without the texture transforms of its bitmaps at any depth, which are added to `placements`."""
    if bsdf["type"] == "bitmap":
        placements.append(bsdf.get("to_uv", np.eye(3)))
    items = ((key, value) for key, value in bsdf.items() if key != "to_uv")
    return {key: without_placement(value, placements) if isinstance(value, dict) else value for key, value in items}


def with_placed_textures(shape: Shape) -> Shape:
    """The same shape with its bitmaps' common transform applied to its texture coordinates.

    Mitsuba compiles the transform of a bitmap into kernels, while texture coordinates are data. Different transforms in
    one material stay.
    """
    placements: list[Array] = []
    bsdf = without_placement(shape.bsdf, placements)
    uv = getattr(shape.mesh.visual, "uv", None)
    moved = any((placement != np.eye(3)).any() for placement in placements)
    if uv is None or not moved or any((other != placements[0]).any() for other in placements):
        return shape
    mesh = shape.mesh.copy(include_cache=True)  # keeps the authored normals
    assert isinstance(mesh.visual, TextureVisuals)
    mesh.visual.uv = uv @ placements[0][:2, :2].T + placements[0][:2, 2]
    return replace(shape, mesh=mesh, bsdf=bsdf)


def load_mesh(shape: Shape, load: Callable[[Bsdf], object]) -> mi.Mesh:
    """The shape in its rest pose, with its material, of which `load` makes an object, and the emission of frame 0."""
    properties = mi.Properties()
    properties["bsdf"] = load(shape.bsdf)
    if shape.radiance is not None:
        light = {"type": "area", "radiance": {"type": "rgb", "value": shape.radiance.at(0).tolist()}}
        properties["emitter"] = mi.load_dict(light)
    uv = getattr(shape.mesh.visual, "uv", None)
    mesh = mi.Mesh(
        shape.name,
        vertex_count=len(shape.mesh.vertices),
        face_count=len(shape.mesh.faces),
        has_vertex_normals=shape.smooth,
        has_vertex_texcoords=uv is not None,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["faces"] = np.uint32(shape.mesh.faces).ravel()
    parameters["vertex_positions"] = upload(shape.mesh.vertices.ravel())
    if shape.smooth:
        parameters["vertex_normals"] = upload(shape.mesh.vertex_normals.ravel())
    if uv is not None:
        parameters["vertex_texcoords"] = upload(uv.ravel())
    parameters.update()
    return mesh


def uploaded(values: NDArray[Any], kind: type[ArrayT]) -> ArrayT:
    """`values` (N,) as an array of that kind, in Dr.Jit's own memory.

    On the CPU Dr.Jit would borrow numpy's memory. It compiles the alignment of such memory into kernels, and recordings
    of frozen functions (Dr.Jit 1.5) miss that another array has taken its place.
    """
    if VARIANT == "cuda_ad_rgb" or not len(values):
        return kind(values)
    own: ArrayT = dr.zeros(kind, len(values))
    dr.make_opaque(own)
    dr.sync_thread()
    np.asarray(own)[:] = values
    return own


def upload(values: NDArray[np.floating]) -> mi.Float:
    """`values` (N,) as data for kernels; Python numbers would be compiled in."""
    return uploaded(values.astype(np.float32), mi.Float)


def columns(vector: Iterable[dr.AnyArray]) -> NDArray[Any]:
    """(N, C) of a Dr.Jit vector of C components and N lanes, without compiling a kernel for this N."""
    return np.stack([np.array(component) for component in vector], axis=-1)


class StockLoader:
    """Loads descriptions from scene files, scaled by 1 / `unit`; shared parts are loaded once."""

    def __init__(self, unit: float = 1.0):
        self.unit = unit
        self.loaded: dict[int, tuple[Bsdf, object]] = {}  # by id: description, kept alive, and object
        self.groups: list[mi.Shape] = []  # for instances
        self.grouped: list[mi.Shape] = []  # the shapes in groups
        self.notes: list[str] = []  # of omissions

    def made(self, description: dict[str, Any], what: str) -> Any:
        """The Mitsuba object of a resolved dictionary, without properties that its plugin does not have.

        Raises BadInput, which begins with `what`, if it cannot be loaded.
        """
        try:
            return mi.load_dict(description)
        except RuntimeError as error:
            text = str(error)
            unused = text if "unreferenced propert" in text else ""
            unknown = set(re.findall(r'^  - \w+ "([^"]+)":', unused, re.MULTILINE))
            if not unknown & description.keys():
                raise BadInput(f"{what} is empty, damaged or cannot be used: {mitsuba_reason(error)}") from None
        names = ", ".join(f"'{name}'" for name in sorted(unknown))
        self.notes.append(f"{what}: this Mitsuba does not have {names}: left out")
        return self.made({key: value for key, value in description.items() if key not in unknown}, what)

    def load(self, description: Bsdf) -> Any:
        if id(description) not in self.loaded:
            what = f"{description.get('filename', description['type'])}{description.get(PLACE, '')}"
            loaded = self.made(to_mitsuba(self.scaled(description), self.load), what)
            self.loaded[id(description)] = (description, loaded)
            if isinstance(loaded, mi.Shape):
                self.notes += check_shape(loaded, what)
                (self.groups if loaded.class_name() == "ShapeGroupPlugin" else self.grouped).append(loaded)
        return self.loaded[id(description)][1]

    def scaled(self, description: Bsdf) -> Bsdf:
        """The description of a part of a material, with heights and volumes scaled from world units."""
        if self.unit != 1 and description["type"] == "bumpmap":
            return description | {"scale": description.get("scale", 1.0) / self.unit}
        return self.placed(description) if description["type"] == "gridvolume" else description

    def placed(self, geometry: Mapping[str, Any]) -> dict[str, Any]:
        """The description of a shape or volume, scaled from world units."""
        if self.unit == 1:
            return dict(geometry)
        return {**geometry, "to_world": np.diag([1 / self.unit] * 3 + [1.0]) @ geometry.get("to_world", np.eye(4))}

    def shape(self, shape: StockShape) -> mi.Shape:
        """Raises BadInput, naming the shape and its file, if it cannot be loaded or is damaged."""
        parts = {"id": shape.name, "bsdf": shape.bsdf, "emitter": shape.emitter}
        description = self.placed(shape.geometry) | {key: value for key, value in parts.items() if value is not None}
        where = f"shape '{shape.name}'{shape.geometry.get(PLACE, '')}"
        where += f" ({shape.geometry['filename']})" if "filename" in shape.geometry else ""
        loaded = self.made(to_mitsuba(description, self.load), where)
        self.notes += check_shape(loaded, where)
        return loaded

    def light(self, light: StockLight) -> mi.Emitter:
        """Raises BadInput, naming the light, if it cannot be loaded."""
        emitter, position = dict(light.emitter), light.emitter.get("position")
        if isinstance(position, list):
            emitter["position"] = [x / self.unit for x in position]
        if "to_world" in emitter:  # of which Mitsuba takes directions, too: no scale may be in it
            emitter["to_world"] = emitter["to_world"].copy()
            emitter["to_world"][:3, 3] /= self.unit
        where = f"light '{light.name}'{light.emitter.get(PLACE, '')}"
        return self.made(to_mitsuba(emitter, self.load) | {"id": light.name}, where)


def mitsuba_reason(error: Exception) -> str:
    """Mitsuba's error message in one line, without locations in its source code."""
    text = " ".join(str(error).split())
    text = re.sub(r".*\[\w+(\.(cpp|h):\d+)?\] |Error while loading string ", "", text)
    text = re.sub(r'^(At|While loading) dictionary node "\w*": |failed to instantiate .*?: ', "", text)
    return "it cannot be read" if not text or text.startswith("jit_") else text


MAX_EXTENT = 1e18  # largest coordinate whose square is a finite float32
BAD_NORMALS = "normals that are zero or not finite: computed ones instead"
BAD_COORDINATES = "texture coordinates that are not finite: 0 instead"


def without_direction(normals: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which of `normals` (N, 3) float32 cannot normalise."""
    length = np.linalg.norm(normals.astype(np.float64), axis=1)
    return ~((length > 1 / MAX_EXTENT) & (length < MAX_EXTENT))


def mend_mesh(mesh: mi.Mesh) -> list[str]:
    """Replace what of a mesh would make pixels NaN. Returns notes."""
    notes = []
    parameters = mi.traverse(mesh)
    normals = np.array(parameters["vertex_normals"]).reshape(-1, 3)
    bad = without_direction(normals)
    if bad.any() and bad[np.array(parameters["faces"])].any():
        mesh.recompute_vertex_normals()
        computed = np.array(mi.traverse(mesh)["vertex_normals"]).reshape(-1, 3)
        parameters["vertex_normals"] = upload(np.where(bad[:, None], computed, normals).ravel())
        notes.append(BAD_NORMALS)
    uv = np.array(parameters["vertex_texcoords"])
    if not np.isfinite(uv).all():
        parameters["vertex_texcoords"] = upload(np.nan_to_num(uv, posinf=0, neginf=0))
        notes.append(BAD_COORDINATES)
    if notes:
        parameters.update()
    return notes


def check_shape(shape: mi.Shape, where: str) -> list[str]:
    """Raise BadInput, which begins with `where`, for an empty, damaged or unbounded shape.

    Returns notes, which begin with it too, on what was mended instead.
    """
    if not isinstance(shape, mi.Shape):
        raise BadInput(f"{where} is no shape")
    parameters = mi.traverse(shape)
    notes = []
    if isinstance(shape, mi.Mesh) and "faces" in parameters:
        faces = np.array(parameters["faces"])
        vertices = np.array(parameters["vertex_positions"])
        if not len(faces) or 3 * faces.max() >= len(vertices):
            raise BadInput(f"{where} is empty or damaged: it has {len(vertices) // 3} vertices and no sound faces")
        if not np.isfinite(vertices).all():
            raise BadInput(f"{where} is damaged: it has vertices that are not finite")
        notes = [f"{where}: {note}" for note in mend_mesh(shape)]
    box = shape.bbox()
    if shape.class_name() != "ShapeGroupPlugin" and not np.abs(corners(box)).max() < MAX_EXTENT:
        raise BadInput(f"{where} is too far away or too large: it reaches from {box.min} to {box.max}")
    return notes


def corners(box: mi.ScalarBoundingBox3f) -> Array:
    """The least and the greatest coordinates (2, 3) of a box."""
    return np.array([np.array(box.min), np.array(box.max)], np.float64).reshape(2, 3)
