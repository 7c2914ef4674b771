"""What the primary rays see, free of noise: geometry, material and light seen directly."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.loading import columns
from render.stage import Stage
from scenes.camera import Array, View


def depth_along_axis(stage: Stage, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, view: View) -> NDArray[np.float32]:
    """Distance (N,) along the viewing axis, in world units; 0 where nothing is hit. float32, as stored."""
    distance = np.array(dr.select(si.is_valid(), si.t, 0), dtype=np.float64) * stage.unit
    cosine = columns(ray.d).astype(np.float64) @ view.camera_to_world[:3, 2]
    depth = distance * cosine
    if stage.has_holes:  # rays begin behind what they have passed through
        begins = columns(ray.o).astype(np.float64) * stage.unit - view.camera_to_world[:3, 3]
        depth += np.where(distance > 0, begins @ view.camera_to_world[:3, 2], 0)
    return depth.astype(np.float32)


class VisibleSurface(NamedTuple):
    """What is seen at some places of an image."""

    depth: Array  # (...,), along the viewing axis; 0 for background
    mesh_id: NDArray[np.uint32]  # (...,), 0 for background
    normal: Array  # (..., 3), geometric


def trace_visible(stage: Stage, view: View, pixels: Array) -> VisibleSurface:
    """What is seen through `pixels` (..., 2). The stage must be posed for `view`'s frame."""
    shape = pixels.shape[:-1]
    ray = stage.rays(view, pixels.reshape(-1, 2))
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
    mesh_id = stage.mesh_id(si)
    dr.eval(si.t, si.n, mesh_id)
    depth = depth_along_axis(stage, si, ray, view).astype(np.float64)
    normal = columns(si.n).astype(np.float64)
    return VisibleSurface(depth.reshape(shape), np.array(mesh_id).reshape(shape), normal.reshape(*shape, 3))


def render_gbuffer(stage: Stage, view: View) -> dict[str, NDArray[Any]]:
    """The noise-free channels (H, W, C), named and shaped as in the channel table (datasets/channels.py).

    The stage must be posed for `view`'s frame.

    albedo: diffuse reflectance + specular reflectance at normal incidence, in [0, 1]; 1 for background.
    normal: the shading normal in world space, of unit length, toward the viewer; 0 for background.
    roughness: GGX alpha in [0, 1]; 1 for diffuse surfaces and background.
    emission: the radiance of lamps and sky that are seen directly.
    depth: along the viewing axis, in world units; 0 for background.
    mesh_id: index of the shape + 1; 0 for background.
    """
    ray = stage.rays(view)
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    hit = si.is_valid()
    normal = stage.normals.evaluate(si, hit)
    normal = dr.select(dr.dot(normal, ray.d) > 0, -normal, normal)
    albedo, roughness = stage.materials.evaluate(si, hit)
    channels: dict[str, dr.AnyArray] = {
        "normal": dr.select(hit, normal, mi.Vector3f(0)),
        "albedo": albedo,
        "roughness": roughness,
        "emission": stage.lights.at(si).eval(si),
        "mesh_id": stage.mesh_id(si),
    }
    dr.eval(channels, si.t)
    arrays = {name: stage.image(value) for name, value in channels.items()}
    arrays["depth"] = depth_along_axis(stage, si, ray, view).reshape(stage.height, stage.width, 1)
    return arrays
