"""Primary visibility without noise, directly and behind mirrors: geometry, materials and emission.

A mirror image is described as if it stood behind the mirror: it has edges, textures and motion like any other surface,
so that denoisers need no special case for it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from datasets.channels import MIRRORED
from render.backend import dr, mi
from render.loading import columns, upload
from render.specular import specular_light
from render.stage import Stage
from scenes.camera import Array, View

MAX_MIRRORS = 4  # along a ray
# Of what a surface reflects, in pixels: where it is blurred more, its own guides serve denoisers better.
MAX_BLUR = 0.75


@dataclass
class MirroredHit:
    """What rays hit behind all mirrors that show it sharply, or the last mirror where that shows only sky."""

    si: mi.SurfaceInteraction3f
    ray: mi.Ray3f  # the last one
    beyond: mi.Float  # path length after the first mirror in Mitsuba's units; 0 without one
    spread: mi.Float  # by which rays diverge, in radians: twice the GGX alpha of each mirror
    blur: mi.Float  # how far they have diverged, in Mitsuba's units
    tint: mi.Color3f  # the product of all mirrors' albedos
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]  # the world's, reflected by the mirrors from first to last

    def in_mirrors(self, normal: mi.Vector3f) -> mi.Vector3f:
        """The mirror image of a world direction (3,)."""
        return mi.Vector3f(*(dr.dot(axis, normal) for axis in self.axes))


def reflected(stage: Stage, hit: MirroredHit, eye_distance: mi.Float, focal: mi.Float) -> MirroredHit:
    """The hits of the rays that mirrors reflect; unchanged elsewhere, and where a ray misses or the picture is blurred.

    `eye_distance` is the length of primary rays, `focal` the focal length in pixels.
    """
    here = hit.si
    is_mirror, albedo, alpha = stage.materials.mirror_at(here)
    normal = stage.normals.evaluate(here, is_mirror)

    def flipped(direction: mi.Vector3f) -> mi.Vector3f:
        return direction - 2 * dr.dot(direction, normal) * normal

    onward = stage.past_cutouts(here.spawn_ray(flipped(hit.ray.d)))
    there = stage.mitsuba_scene.ray_intersect(onward, mi.RayFlags.All, coherent=False, active=is_mirror)
    step = dr.norm(there.p - here.p)
    beyond = hit.beyond + step
    spread = hit.spread + 2 * alpha
    blur = hit.blur + spread * step
    is_sharp = blur * focal < MAX_BLUR * (eye_distance + beyond)
    x, y, z = map(flipped, hit.axes)
    shown = MirroredHit(there, onward, beyond, spread, blur, hit.tint * albedo, (x, y, z))
    result: MirroredHit = dr.select(is_mirror & there.is_valid() & is_sharp, shown, hit)
    dr.eval(result)
    return result


def depth_along_axis(
    stage: Stage, si: mi.SurfaceInteraction3f, ray: mi.Ray3f, view: View, beyond: mi.Float | None = None
) -> NDArray[np.float32]:
    """Depth (N,) along the viewing axis, in world units; 0 where nothing is hit. float32, as stored.

    `beyond` is the length of the path, in Mitsuba's units, after its reflection by a mirror at `si`.
    """
    length = si.t if beyond is None else si.t + beyond
    distance = np.array(dr.select(si.is_valid(), length, 0), dtype=np.float64) * stage.unit
    depth = distance * (columns(ray.d).astype(np.float64) @ view.camera_to_world[:3, 2])
    if stage.has_cutouts:  # rays begin behind those that they have passed
        begins = columns(ray.o).astype(np.float64) * stage.unit - view.camera_to_world[:3, 3]
        depth += np.where(distance > 0, begins @ view.camera_to_world[:3, 2], 0)
    return depth.astype(np.float32)


class VisibleSurface(NamedTuple):
    depth: Array  # (...,), along the viewing axis; 0 for background
    mesh_id: NDArray[np.uint32]  # (...,), 0 for background
    normal: Array  # (..., 3), geometric


def trace_visible(stage: Stage, view: View, pixels: Array) -> VisibleSurface:
    """The surfaces visible through `pixels` (..., 2), with the stage posed for `view`'s frame."""
    shape = pixels.shape[:-1]
    ray = stage.rays(view, pixels.reshape(-1, 2))
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.Minimal, coherent=True)
    mesh_id = stage.mesh_id(si)
    dr.eval(si.t, si.n, mesh_id)
    depth = depth_along_axis(stage, si, ray, view).astype(np.float64)
    normal = columns(si.n).astype(np.float64)
    return VisibleSurface(depth.reshape(shape), np.array(mesh_id).reshape(shape), normal.reshape(*shape, 3))


def surface_channels(stage: Stage, hit: MirroredHit) -> dict[str, dr.AnyArray]:
    valid = hit.si.is_valid()
    normal = stage.normals.evaluate(hit.si, valid)
    normal = hit.in_mirrors(dr.select(dr.dot(normal, hit.ray.d) > 0, -normal, normal))
    albedo, roughness = stage.materials.evaluate(hit.si, valid)
    return {
        "normal": dr.select(valid, normal, mi.Vector3f(0)),
        "albedo": hit.tint * albedo,
        "roughness": roughness,
        "mesh_id": stage.mesh_id(hit.si),
    }


def render_gbuffer(stage: Stage, view: View, regularise: bool = False) -> dict[str, NDArray[Any]]:
    """The noise-free channels (H, W, C) of the channel table, with the stage posed for `view`'s frame.

    `regularise` is that of the path tracer whose samples complete them.

    albedo: diffuse reflectance + specular reflectance at normal incidence, in [0, 1]; 1 for background.
    normal: the shading normal in world space, of unit length, toward the viewer; 0 for background.
    roughness: GGX alpha in [0, 1]; 1 for diffuse surfaces and background.
    emission: the radiance of lights and sky, directly visible or by way of perfectly specular surfaces alone.
    depth: along the viewing axis, in world units; 0 for background.
    mesh_id: index of the shape + 1; 0 for background.

    In a scene with mirrors all but emission also in mirrored form: surfaces visible in a mirror, as if they stood
    behind it. Their albedo is multiplied by the mirrors', their depth follows from the length of the whole path.
    """
    ray = stage.rays(view)
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    axes = (mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
    direct = mirrored = MirroredHit(si, ray, mi.Float(0), mi.Float(0), mi.Float(0), mi.Color3f(1), axes)
    channels = {**surface_channels(stage, direct), "emission": stage.lights.at(si).eval(si)}
    shines = stage.specular.at(si.bsdf(), si.is_valid())
    dr.eval(channels, si.t, shines)
    arrays = {name: stage.image(value) for name, value in channels.items()}
    if np.array(shines).any():
        events = stage.max_events(regularise)
        scene, lights, specular = stage.mitsuba_scene, stage.lights, stage.specular
        light = specular_light(scene, lights, specular, ray, events, np.array(shines), stage.freezes)
        arrays["emission"] = np.where(stage.image(shines), light.reshape(arrays["emission"].shape), arrays["emission"])
    arrays["depth"] = depth_along_axis(stage, si, ray, view).reshape(stage.height, stage.width, 1)
    if stage.materials.has_mirrors:
        focal = upload(np.abs(view.K[:1, 0]))
        for _ in range(MAX_MIRRORS):
            before = mirrored.beyond
            mirrored = reflected(stage, mirrored, si.t, focal)
            if dr.all(mirrored.beyond == before):
                break
        shown = {MIRRORED[name]: value for name, value in surface_channels(stage, mirrored).items()}
        dr.eval(shown, mirrored.beyond)
        arrays |= {name: stage.image(value) for name, value in shown.items()}
        depth = depth_along_axis(stage, si, ray, view, mirrored.beyond)
        arrays[MIRRORED["depth"]] = depth.reshape(stage.height, stage.width, 1)
    return arrays
