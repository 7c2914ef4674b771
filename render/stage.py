"""An animated scene in Mitsuba, posed for one frame at a time without recompiling kernels."""

import gc
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar
from weakref import finalize, proxy

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.lights import Lights
from render.loading import StockLoader, corners, load_mesh, upload, with_placed_textures
from render.materials import BsdfParameters, MaterialTable, bsdfs_of, registry_index, registry_number, registry_table
from render.palette import palette
from render.posing import Changes, StockParameters, as_parameter, mesh_changes
from render.shading_normals import ShadingNormals
from scenes.animation import Scene, StockLight, StockShape
from scenes.camera import Array, View, directions, pixel_centres

T = TypeVar("T")

MAX_CUTOUTS = 32  # that a primary ray passes
MAX_EVENTS = 8  # in a chain of specular events: through a vitrine of solid panes, and a bottle in it
CURVES = ("BSplineCurve", "LinearCurve")
CUTOUT = 0.999  # least transmission of a cut-out


def unit_of(extents: list[float]) -> float:
    """Mitsuba's unit in world units: 1, or a power of two for very small scenes.

    `extents` are the largest coordinates of its shapes. Mitsuba moves the origins of rays away from surfaces by a
    multiple of 1 + the largest coordinate, which is far for small scenes, and as it should be for large ones.
    """
    extent = max(extents, default=1.0)
    if extent == 0 or extent > 1 / 16:
        return 1.0
    return float(2.0 ** np.round(np.log2(extent)))


def has_texture(emitter: dict[str, Any] | None) -> bool:
    """Whether emitted radiance varies over a surface."""
    radiance = (emitter or {}).get("radiance")
    return isinstance(radiance, dict) and radiance["type"] not in ("rgb", "spectrum", "uniform")


def is_masked(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF has a mask in it: Mitsuba cannot sample a single lobe of one."""
    return bsdf.class_name() == "MaskBSDF" or any(map(is_masked, BsdfParameters(bsdf).nested.values()))


def has_flag(bsdf: mi.BSDF, component: int, flag: mi.BSDFFlags) -> bool:
    return bool(mi.has_flag(bsdf.flags(component), flag))


def delta_lobes(bsdf: mi.BSDF) -> list[int]:
    """The component indices of the delta lobes that can be sampled alone."""
    if is_masked(bsdf):
        return []
    return [i for i in range(bsdf.component_count()) if has_flag(bsdf, i, mi.BSDFFlags.Delta)]


def is_smooth_glass(bsdf: mi.BSDF) -> bool:
    """Whether a BSDF reflects and transmits perfectly specularly, and nothing else."""
    lobes = delta_lobes(bsdf)
    reflects = [has_flag(bsdf, i, mi.BSDFFlags.DeltaReflection) for i in lobes]
    return len(lobes) == bsdf.component_count() and any(reflects) and not all(reflects)


class Stage:
    """An animated scene loaded into Mitsuba for images of `height` x `width` pixels.

    It has the pose of one frame at a time: `pose` it before every use of `mitsuba_scene`. `notes` list properties of
    stock shapes and lights that Mitsuba does not support. Raises BadInput, naming the shape or light, if one cannot be
    loaded, moved or changed.
    """

    def __init__(self, scene: Scene, height: int, width: int):
        gc.collect()  # recordings keep earlier scenes, which every virtual call would trace too
        self.scene = scene = replace(scene, shapes=tuple(map(with_placed_textures, scene.shapes)))
        self.height = height
        self.width = width
        palette()
        loader = StockLoader()
        loaded = [loader.shape(shape) for shape in scene.stock]
        # Upper bounds of coordinates in frame 0:
        extents = [np.abs(each.mesh.bounds).max() + np.abs(each.motion.position.at(0)).max() for each in scene.shapes]
        self.unit = unit_of([*extents, *(np.abs(corners(shape.bbox())).max() for shape in loaded)])
        if any(shape.class_name() in CURVES for shape in (*loaded, *loader.grouped)):
            self.unit = 1.0  # no transform scales how thick they are
        if self.unit != 1:
            loader = StockLoader(self.unit)
            loaded = [loader.shape(shape) for shape in scene.stock]
        self.notes = loader.notes
        content: dict[str, object] = {"type": "scene"}
        content |= {shape.name: load_mesh(shape, loader.load) for shape in scene.shapes}
        content |= {shape.name: instance for shape, instance in zip(scene.stock, loaded, strict=True)}
        content |= {f"_group {index}": group for index, group in enumerate(loader.groups)}
        content |= {light.name: loader.light(light) for light in scene.lights}
        if scene.sky is not None:
            content["sky"] = {"type": "envmap", "bitmap": mi.Bitmap(scene.sky.astype(np.float32))}
        # By default meshes that share a material are merged, and lose their ids.
        self.mitsuba_scene = mi.load_dict(content, optimize=False)
        self.lights = Lights(self.mitsuba_scene)
        self.parameters = mi.traverse(self.mitsuba_scene)
        by_name = {shape.id(): shape for shape in self.mitsuba_scene.shapes()}
        self.shapes = [by_name[shape.name] for shape in scene.meshes]
        described: list[StockShape | StockLight] = [*scene.stock, *scene.lights]
        self.stock = [StockParameters(stock, self.parameters, self.unit) for stock in described]
        self.bsdfs = bsdfs_of([*self.shapes, *loader.grouped])
        self.read_bsdfs(self.bsdfs)
        of_stock = [(loaded, text) for text, loaded in loader.loaded.values() if isinstance(loaded, mi.BSDF)]
        of_shapes = [(shape.bsdf(), of.bsdf) for shape, of in zip(self.shapes, scene.meshes, strict=True) if of.bsdf]
        # By registry index. Shapes in groups may have a default that nothing describes.
        self.bsdf_descriptions = {registry_number(mi.BSDFPtr(bsdf)): text for bsdf, text in of_stock + of_shapes}
        mesh_ids = {registry_number(mi.ShapePtr(shape)): index for index, shape in enumerate(self.shapes, 1)}
        self.mesh_id_of_shape = registry_table(mi.UInt32, mesh_ids)
        self.has_instances = bool(loader.grouped)
        # Dr.Jit 1.5 cannot freeze textured area lights, and scenes without shapes while another scene is loaded.
        self.freezes = bool(self.shapes) and not any(has_texture(shape.emitter) for shape in scene.stock)
        self.posed: dict[str, NDArray[np.float32]] = {}
        self.poses = 0  # how often something has changed
        self.recordings: dict[Callable[..., Any], Callable[..., Any]] = {}
        self.pose(0)

    def read_bsdfs(self, bsdfs: dict[int, mi.BSDF]) -> None:
        self.materials = MaterialTable(bsdfs)
        self.normals = ShadingNormals(bsdfs)
        lobes = {index: delta_lobes(bsdf) for index, bsdf in bsdfs.items()}
        self.delta_lobes = sorted({lobe for of_bsdf in lobes.values() for lobe in of_bsdf})
        # The BSDFs that chains of specular events continue from, and those of smooth glass, if there are any.
        self.specular = registry_table(mi.Bool, {index: bool(of_bsdf) for index, of_bsdf in lobes.items()})
        glass = {index: is_smooth_glass(bsdf) for index, bsdf in bsdfs.items()}
        self.glass = registry_table(mi.Bool, glass) if any(glass.values()) else None
        self.looks_through = self.materials.has_mirrors or self.glass is not None
        # Masks have null transmission; so has thin glass.
        self.has_cutouts = any(mi.has_flag(bsdf.flags(), mi.BSDFFlags.Null) for bsdf in bsdfs.values())

    def replay(self, function: Callable[..., T], *arguments: Any, freezes: bool = True) -> T:
        """`function(self, *arguments)`, evaluated; recorded by Dr.Jit, since tracing it takes longer than running it.

        Functions that cannot be recorded, which do not `freezes`, and all of scenes that cannot, are only evaluated.
        What changes between calls, other than the pose, must be among the arguments: arrays as data, or hashable.
        """
        freezes = freezes and self.freezes
        if freezes and function not in self.recordings:
            own = proxy(self)  # Mitsuba cannot free a scene during a recording, when the collector of cycles might
            frozen: Any = dr.freeze(lambda *arguments: function(own, *arguments), state_fn=lambda *_: own.state())
            finalize(self, frozen.clear)  # else recordings would keep the scene
            self.recordings[function] = frozen
        result = self.recordings[function](*arguments) if freezes else function(self, *arguments)
        dr.eval(result)
        return result

    def state(self) -> list[Any]:
        """All that kernels read of it, and the palette, whose objects they may call."""
        tables = [self.materials.state(), self.specular, self.glass, self.mesh_id_of_shape]
        return [palette(), self.mitsuba_scene, self.lights, *tables]

    def mesh_id(self, si: mi.SurfaceInteraction3f) -> mi.UInt32:
        """The mesh id at a surface interaction: the shape's index + 1, or 0 for none."""
        shape = registry_index(si.shape)
        if self.has_instances:
            instance = registry_index(si.instance)
            shape = dr.select(instance != 0, instance, shape)
        return dr.gather(mi.UInt32, self.mesh_id_of_shape, shape, si.is_valid())

    def pose(self, frame: float) -> None:
        """Move the meshes and set the lights as in `frame`. Changes enter kernels as data."""
        first = not self.posed
        changes: Changes = {}
        for shape in self.scene.shapes:
            changes |= mesh_changes(shape, frame, self.unit, moves=first or shape.motion.varies())
        for stock in self.stock:
            changes |= stock.changes(frame)
        changed = {name for name, value in changes.items() if not np.array_equal(value, self.posed.get(name, np.nan))}
        # Mitsuba recomputes the authored normals of moved vertices otherwise.
        changed |= {name.replace(".vertex_positions", ".vertex_normals") for name in changed} & changes.keys()
        changes = {name: changes[name] for name in changes if name in changed}
        for name, value in changes.items():
            self.parameters[name] = as_parameter(value, self.parameters[name])
        if changes:
            self.parameters.update()  # every update rebuilds the top level of the acceleration structure
            self.posed.update(changes)
            self.poses += 1

    def max_events(self, regularise: bool = False) -> int:
        """Of the chains of specular events whose light is emission; regularised paths have but one such event."""
        return min(1 if regularise else MAX_EVENTS, self.scene.max_depth - 1)

    def image(self, value: dr.AnyArray) -> NDArray[Any]:
        """(H, W, C) of a Dr.Jit value of C components with a lane for each pixel, or one for all."""
        array = np.array(value)
        planes = np.atleast_2d(array).reshape(-1, array.shape[-1])
        return np.broadcast_to(planes.T, (self.height * self.width, len(planes))).reshape(self.height, self.width, -1)

    def view(self, frame: float) -> View:
        """Camera and object poses of `frame`, independent of the current pose."""
        return self.scene.view(frame, self.height, self.width)

    def rays(self, view: View, pixels: Array | None = None) -> mi.Ray3f:
        """Rays through `pixels` (N, 2) of `view`, by default all pixel centres in row-major order.

        They begin at the eye, or behind the cut-outs (of masks) that they have passed.
        """
        if pixels is None:
            pixels = pixel_centres(self.height, self.width).reshape(-1, 2)
        towards = directions(pixels, view)
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        origin = mi.Point3f(*map(upload, view.camera_to_world[:3, 3:] / self.unit))
        ray = mi.Ray3f(origin, mi.Vector3f(*map(upload, towards.T)))
        ray = self.past_cutouts(ray)
        dr.eval(ray)
        return ray

    def past_cutouts(self, ray: mi.Ray3f) -> mi.Ray3f:
        """The rays from behind the cut-outs that they hit first, up to MAX_CUTOUTS."""
        if not self.has_cutouts:
            return ray

        def step(number: mi.UInt32, ray: mi.Ray3f, cutout: mi.Bool) -> tuple[mi.UInt32, mi.Ray3f, mi.Bool]:
            si = self.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
            hit = si.is_valid()
            cutout = hit & (dr.min(si.bsdf().eval_null_transmission(si, hit)) > CUTOUT)
            ray.o = dr.select(cutout, si.spawn_ray(ray.d).o, ray.o)
            return number + 1, ray, cutout

        start = mi.UInt32(0), mi.Ray3f(ray), mi.Bool(True)
        return dr.while_loop(start, lambda number, _, cutout: cutout & (number < MAX_CUTOUTS), step)[1]
