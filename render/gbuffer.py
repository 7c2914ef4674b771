"""What the primary rays see, free of noise: geometry, material and light seen directly."""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type"

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.loading import columns
from render.mirrors import Seen, look_through
from render.stage import Stage
from scenes.camera import Array, View


def depth_along_axis(
    stage: Stage, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, view: View, beyond: mi.Float | None = None
) -> NDArray[np.float32]:
    """Distance (N,) along the viewing axis, in world units; 0 where nothing is hit. float32, as stored.

    `beyond` is how much farther, in Mitsuba's units, rays go that a mirror at `si` reflects.
    """
    length = si.t if beyond is None else si.t + beyond
    distance = np.array(dr.select(si.is_valid(), length, 0), dtype=np.float64) * stage.unit
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


def surface_channels(stage: Stage, seen: Seen) -> dict[str, dr.AnyArray]:
    """Normals, albedo, roughness and mesh ids of what is seen."""
    hit = seen.si.is_valid()
    normal = stage.normals.evaluate(seen.si, hit)
    normal = seen.in_mirrors(dr.select(dr.dot(normal, seen.ray.d) > 0, -normal, normal))
    albedo, roughness = stage.materials.evaluate(seen.si, hit)
    return {
        "normal": dr.select(hit, normal, mi.Vector3f(0)),
        "albedo": seen.tint * albedo,
        "roughness": roughness,
        "mesh_id": stage.mesh_id(seen.si),
    }


def render_gbuffer(stage: Stage, view: View) -> dict[str, NDArray[Any]]:
    """The noise-free channels (H, W, C), named and shaped as in the channel table (datasets/channels.py).

    The stage must be posed for `view`'s frame.

    albedo: diffuse reflectance + specular reflectance at normal incidence, in [0, 1]; 1 for background.
    normal: the shading normal in world space, of unit length, toward the viewer; 0 for background.
    roughness: GGX alpha in [0, 1]; 1 for diffuse surfaces and background.
    emission: the radiance of lamps and sky that are seen directly.
    depth: along the viewing axis, in world units; 0 for background.
    mesh_id: index of the shape + 1; 0 for background.

    In a scene with mirrors all but emission also as `mirrored_`NAME: in mirrors of what they show, as if it stood
    behind them. Albedo is times theirs, depth follows from the length of the whole way.
    """
    ray = stage.rays(view)
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    own = Seen.directly(si, ray)
    channels = {**surface_channels(stage, own), "emission": stage.lights.at(si).eval(si)}
    dr.eval(channels, si.t)
    arrays = {name: stage.image(value) for name, value in channels.items()}
    arrays["depth"] = depth_along_axis(stage, si, ray, view).reshape(stage.height, stage.width, 1)
    if stage.has_mirrors:
        seen = look_through(stage, own)
        shown = {f"mirrored_{name}": value for name, value in surface_channels(stage, seen).items()}
        dr.eval(shown, seen.beyond)
        arrays |= {name: stage.image(value) for name, value in shown.items()}
        depth = depth_along_axis(stage, si, ray, view, seen.beyond)
        arrays["mirrored_depth"] = depth.reshape(stage.height, stage.width, 1)
    return arrays
