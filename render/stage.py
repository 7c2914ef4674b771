"""An animated scene in Mitsuba, posed at one frame at a time without recompiling a kernel."""

from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from trimesh.visual import TextureVisuals

from render.backend import dr, mi
from render.lights import Lights
from render.materials import MaterialTable, registry_index, registry_table
from render.palette import palette
from scenes.animation import Scene, Shape
from scenes.bsdf import Bsdf
from scenes.camera import Array, View, directions, pixel_centres

T = TypeVar("T", np.float32, np.uint32)


def to_mitsuba(description: dict[str, Any]) -> dict[str, Any]:
    """A Mitsuba dictionary with its numpy arrays, the values and placement of bitmaps, as Mitsuba's types."""

    def convert(key: str, value: Any) -> object:
        if isinstance(value, dict):
            return to_mitsuba(value)
        if key == "to_uv":
            return mi.ScalarTransform3f(value)
        if isinstance(value, np.ndarray):
            return mi.TensorXf(upload(np.float32(value).ravel()), value.shape)
        return value

    return {key: convert(key, value) for key, value in description.items()}


def bitmaps_of(bsdf: Bsdf) -> list[Bsdf]:
    """The bitmaps in a material's dictionary, at any depth."""
    nested = [value for value in bsdf.values() if isinstance(value, dict)]
    own = [bsdf] if bsdf["type"] == "bitmap" else []
    return own + [bitmap for value in nested for bitmap in bitmaps_of(value)]


def without_placement(bsdf: Bsdf) -> Bsdf:
    """The material with all its bitmaps where the texture coordinates put them."""
    return {
        key: without_placement(value) if isinstance(value, dict) else value
        for key, value in bsdf.items()
        if key != "to_uv"
    }


def with_placed_textures(shape: Shape) -> Shape:
    """The same shape with its bitmaps' common placement in its texture coordinates.

    Mitsuba compiles a bitmap's placement into kernels, while texture coordinates are data: so all textures share a
    program. Bitmaps of one material that are placed differently stay as they are.
    """
    placements = [bitmap.get("to_uv", np.eye(3)) for bitmap in bitmaps_of(shape.bsdf)]
    uv = getattr(shape.mesh.visual, "uv", None)
    if uv is None or not placements or any((other != placements[0]).any() for other in placements):
        return shape
    mesh = shape.mesh.copy(include_cache=True)  # without it the authored normals are lost
    assert isinstance(mesh.visual, TextureVisuals)
    mesh.visual.uv = uv @ placements[0][:2, :2].T + placements[0][:2, 2]
    return replace(shape, mesh=mesh, bsdf=without_placement(shape.bsdf))


def load_mesh(shape: Shape) -> mi.Mesh:
    """The shape in its rest pose, with its material, and lit as in frame 0."""
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(to_mitsuba(shape.bsdf))
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


def aligned(values: NDArray[T]) -> NDArray[T]:
    """`values` (N,), of 4 bytes each, where a kernel for any other such array can read them.

    On the CPU Dr.Jit borrows numpy's memory and compiles its alignment into kernels.
    """
    spare = 64 // 4
    buffer = np.empty(len(values) + spare, values.dtype)
    start = -(buffer.ctypes.data // 4) % spare
    buffer[start : start + len(values)] = values
    return buffer[start : start + len(values)]


def upload(values: NDArray[np.floating]) -> mi.Float:
    """`values` (N,) as data for kernels: Python numbers would be compiled into them."""
    return mi.Float(aligned(values.astype(np.float32)))


def columns(vector: dr.AnyArray) -> NDArray[Any]:
    """(N, C) of a Dr.Jit vector of C components and N lanes; its own dtype.

    Taken at once they would be put together by a kernel that is compiled for this N.
    """
    return np.stack([np.array(component) for component in vector], axis=-1)


def unit_of(scene: Scene) -> float:
    """How many world units a unit of Mitsuba's is: 1, or a power of two for very small and very large scenes.

    Mitsuba keeps a ray from hitting the surface it leaves by a step that suits scenes of human size.
    """
    sizes = [np.abs(shape.mesh.bounds).max() + np.abs(shape.motion.position.at(0)).max() for shape in scene.shapes]
    extent = float(max(sizes, default=1))
    if extent == 0 or 1 / 16 < extent < 1024:
        return 1.0
    return float(2.0 ** np.round(np.log2(extent)))


class Stage:
    """An animated scene loaded into Mitsuba for images of `height` x `width` pixels.

    It stands as in one frame at a time: `pose` it before every use of `mitsuba_scene`. Raises BadInput, naming the
    shape, for a material that is not supported.
    """

    def __init__(self, scene: Scene, height: int, width: int):
        self.scene = scene = replace(scene, shapes=tuple(map(with_placed_textures, scene.shapes)))
        self.height = height
        self.width = width
        self.unit = unit_of(scene)
        palette()
        content: dict[str, object] = {"type": "scene"}
        content |= {shape.name: load_mesh(shape) for shape in scene.shapes}
        if scene.sky is not None:
            content["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(scene.sky.astype(np.float32))}
        # Without optimize=False meshes that share a material are merged, and their ids vanish.
        self.mitsuba_scene = mi.load_dict(content, optimize=False)
        self.lights = Lights(self.mitsuba_scene)
        self.parameters = mi.traverse(self.mitsuba_scene)
        loaded = {shape.id(): shape for shape in self.mitsuba_scene.shapes()}
        self.shapes = [loaded[shape.name] for shape in scene.shapes]
        self.materials = MaterialTable(self.shapes)
        self.mesh_id_of_shape = registry_table([mi.ShapePtr(shape) for shape in self.shapes], first=1)
        self.posed: dict[str, NDArray[np.float32]] = {}
        self.poses = 0  # how often something has changed
        self.pose(0)

    def mesh_id(self, si: mi.SurfaceInteraction3f) -> mi.UInt32:
        """Which of the scene's shapes a surface interaction lies on: its index + 1, or 0 for none."""
        return dr.gather(mi.UInt32, self.mesh_id_of_shape, registry_index(si.shape), si.is_valid())

    def pose(self, frame: float) -> None:
        """Move the meshes and set the lights as in `frame`. All changes enter the kernels as data."""
        changes: dict[str, NDArray[np.float32]] = {}
        for shape in self.scene.shapes:
            if shape.motion.varies() or not self.posed:
                matrix = shape.motion.matrix(frame)
                vertices = (shape.mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]) / self.unit
                changes[f"{shape.name}.vertex_positions"] = np.float32(vertices).ravel()
                if shape.smooth:  # in the same update: positions alone would recompute the authored normals
                    normals = shape.mesh.vertex_normals @ matrix[:3, :3].T
                    changes[f"{shape.name}.vertex_normals"] = np.float32(normals).ravel()
            if shape.radiance is not None:
                changes[f"{shape.name}.emitter.radiance.value"] = shape.radiance.at(frame).astype(np.float32)
        changes = {
            name: value
            for name, value in changes.items()
            if name not in self.posed or not np.array_equal(value, self.posed[name])
        }
        for name, value in changes.items():
            self.parameters[name] = mi.Color3f(*map(mi.Float, value[:, None])) if value.shape == (3,) else upload(value)
        if changes:
            self.parameters.update()  # once a pose: every update rebuilds the top level of the ray-tracing structure
            self.posed.update(changes)
            self.poses += 1

    def image(self, value: dr.AnyArray) -> NDArray[Any]:
        """(H, W, C) of a Dr.Jit value of C components with a lane for each pixel, or one for all; its own dtype."""
        array = np.array(value)
        planes = np.atleast_2d(array).reshape(-1, array.shape[-1])
        return np.broadcast_to(planes.T, (self.height * self.width, len(planes))).reshape(self.height, self.width, -1)

    def view(self, frame: float) -> View:
        """Camera and meshes of `frame`, whatever the stage is posed for."""
        return self.scene.view(frame, self.height, self.width)

    def rays(self, view: View, pixels: Array | None = None) -> mi.Ray3f:
        """Rays through `pixels` (N, 2) of `view`; without them through all pixel centres, row by row."""
        if pixels is None:
            pixels = pixel_centres(self.height, self.width).reshape(-1, 2)
        towards = directions(pixels, view)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        origin = mi.Point3f(*map(upload, view.camera_to_world[:3, 3:] / self.unit))
        ray = mi.Ray3f(origin, mi.Vector3f(*map(upload, towards.T)))
        dr.eval(ray)
        return ray
