"""An animated scene in Mitsuba, posed at one frame at a time without recompiling a kernel."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from errors import BadInput
from render.backend import dr, mi
from scenes.animation import Scene, Shape
from scenes.camera import Array, View, directions, pixel_centres

MATERIALS = ("diffuse", "twosided")


def check_material(shape: str, bsdf: dict[str, Any]) -> None:
    """Raise BadInput for a BSDF whose albedo and roughness the G-buffer could not tell."""
    if bsdf["type"] not in MATERIALS:
        raise BadInput(f"shape '{shape}': the material '{bsdf['type']}' is not supported; use {' or '.join(MATERIALS)}")
    for value in bsdf.values():
        if isinstance(value, dict) and bsdf["type"] == "twosided":
            check_material(shape, value)


def load_mesh(shape: Shape) -> Any:
    """A mi.Mesh in the shape's rest pose."""
    check_material(shape.name, shape.bsdf)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(shape.bsdf)
    if shape.radiance is not None:
        light = {"type": "area", "radiance": {"type": "rgb", "value": shape.radiance.at(0).tolist()}}
        properties["emitter"] = mi.load_dict(light)
    mesh = mi.Mesh(
        shape.name,
        vertex_count=len(shape.mesh.vertices),
        face_count=len(shape.mesh.faces),
        has_vertex_normals=shape.smooth,
        has_vertex_texcoords=False,
        props=properties,
    )
    parameters = mi.traverse(mesh)
    parameters["faces"] = np.uint32(shape.mesh.faces).ravel()
    parameters["vertex_positions"] = np.float32(shape.mesh.vertices).ravel()
    if shape.smooth:
        parameters["vertex_normals"] = np.float32(shape.mesh.vertex_normals).ravel()
    parameters.update()
    return mesh


def upload(values: Array) -> Any:
    """mi.Float (N,) of `values` (N,), as data: Python numbers would be compiled into the kernel.

    On the CPU Dr.Jit borrows numpy's memory and compiles its alignment in as well, so it is always aligned here.
    """
    spare = 64 // 4
    buffer = np.empty(len(values) + spare, np.float32)
    start = -(buffer.ctypes.data // 4) % spare
    buffer[start : start + len(values)] = values
    return mi.Float(buffer[start : start + len(values)])


class Stage:
    """`scene` loaded for images of `height` x `width` pixels. `pose` before every use of `mitsuba_scene`."""

    def __init__(self, scene: Scene, height: int, width: int):
        self.scene, self.height, self.width = scene, height, width
        meshes = {shape.name: load_mesh(shape) for shape in scene.shapes}
        # Without optimize=False meshes that share a material are merged, and their ids vanish.
        self.mitsuba_scene = mi.load_dict({"type": "scene", **meshes}, optimize=False)
        self.parameters = mi.traverse(self.mitsuba_scene)
        self.mesh_id_of_shape = self._mesh_ids()
        self.posed: dict[str, NDArray[Any]] = {}
        self.pose(0)

    def _mesh_ids(self) -> Any:
        """mi.UInt32 table from Mitsuba's registry index of a shape to our mesh id; 0 for no shape."""
        loaded = {shape.id(): shape for shape in self.mitsuba_scene.shapes()}
        pointers = [mi.ShapePtr(loaded[shape.name]) for shape in self.scene.shapes]
        indices = [int(np.array(dr.reinterpret_array(mi.UInt32, pointer))[0]) for pointer in pointers]
        table = np.zeros(max(indices) + 1, np.uint32)
        table[indices] = np.arange(len(indices)) + 1
        return mi.UInt32(table)

    def mesh_id(self, si: Any) -> Any:
        """mi.UInt32: which of the scene's shapes (index + 1) a surface interaction lies on, 0 for none."""
        index = dr.reinterpret_array(mi.UInt32, si.shape)
        return dr.gather(mi.UInt32, self.mesh_id_of_shape, index, si.is_valid())  # type: ignore[arg-type]

    def pose(self, frame: float) -> None:
        """Move meshes and set lights to where they are in `frame`. All changes enter the kernels as data."""
        changes: dict[str, NDArray[Any]] = {}
        for shape in self.scene.shapes:
            if shape.motion.varies() or not self.posed:
                matrix = shape.motion.matrix(frame)
                vertices = shape.mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]
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
            self.parameters[name] = mi.Color3f(*map(mi.Float, value[:, None])) if value.shape == (3,) else value
        if changes:
            self.parameters.update()  # once a frame: every update rebuilds the top level of the ray-tracing structure
            self.posed.update(changes)

    def view(self, frame: float) -> View:
        return self.scene.view(frame, self.height, self.width)

    def rays(self, view: View, pixels: Array | None = None) -> Any:
        """mi.Ray3f through `pixels` (N, 2) of `view`; without them through all pixel centres, row by row."""
        if pixels is None:
            pixels = pixel_centres(self.height, self.width).reshape(-1, 2)
        towards = directions(pixels, view)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        origin = mi.Point3f(*map(upload, view.camera_to_world[:3, 3:]))
        ray = mi.Ray3f(origin, mi.Vector3f(*map(upload, towards.T)))
        dr.eval(ray)
        return ray
