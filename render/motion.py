"""Motion vectors of disoccluded surfaces (NTD §3.2), and of shadows and reflections (Zeng et al. 2021).

"Temporally Reliable Motion Vectors for Real-time Ray Tracing": a shadow moves with the blocker that the shadow ray
hits, a reflection with the point that the reflected ray hits. Both are those of each pixel's first sample in the first
noise realisation.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.first_bounce import first_bounce, of_sample
from render.gbuffer import Arrays, VisibleSurface, trace_visible
from render.materials import registry_index
from render.path import PathTracer, SampleRange
from render.stage import Stage
from scenes.camera import FAR_OUTSIDE, Array, View, motion_vectors, move, pixel_centres, project, unproject

PLANE_TOLERANCE = 0.002  # of the depth: a point farther than this from the plane of the visible surface was hidden


def is_same_surface(
    points: Array, mesh_id: NDArray[np.integer], pixels: Array, visible: VisibleSurface, view: View
) -> NDArray[np.bool_]:
    """Whether surface points (..., 3) of `view`'s frame lie on the surfaces `visible` through `pixels` (..., 2).

    Background directions (`mesh_id` (...,) 0) do where background is visible.
    """
    off_plane = np.abs(np.sum(visible.normal * (points - unproject(pixels, visible.depth, view)), axis=-1))
    return (visible.mesh_id == mesh_id) & ((mesh_id == 0) | (off_plane < PLANE_TOLERANCE * visible.depth))


def dual_motion_vectors(
    stage: Stage, depth: Array, mesh_id: NDArray[np.integer], motion: Array, now: View, previous: View
) -> Array:
    """Dual motion vectors (H, W, 2) in pixels, with the stage posed for the previous frame.

    depth, mesh_id (H, W) and motion (H, W, 2) are of the current frame. With y = x + motion and z the position, now, of
    the surface visible at y then, the vector is y + (x - z) - x (NTD Eq. 2). It equals `motion` exactly where the
    surface itself was visible, and where y or x_prev is outside the image or behind a camera.
    """
    height, width = depth.shape
    x = pixel_centres(height, width)
    y = x + motion
    occluder = trace_visible(stage, previous, y)
    then = move(unproject(x, depth, now), mesh_id, now, previous)
    was_visible = is_same_surface(then, mesh_id, y, occluder, previous)
    z = y + motion_vectors(y, occluder.depth, occluder.mesh_id, previous, now)
    x_previous = y + (x - z)
    # z behind the camera is FAR_OUTSIDE, which takes x_previous out of the image too.
    inside = np.all([(p >= 0) & (p < (width, height)) for p in (y, x_previous)], axis=(0, -1))
    return np.where((~was_visible & inside)[..., None], x_previous - x, motion)


class MeshPoint(NamedTuple):
    """Points in the world that move with meshes."""

    point: Array  # (H, W, 3); a direction where not `finite`
    finite: NDArray[np.bool_]  # (H, W)
    mesh_id: NDArray[np.integer]  # (H, W), 0 for static points

    def in_previous(self, now: View, previous: View) -> Array:
        return move(self.point, self.mesh_id, now, previous)

    def moved(self, now: View, previous: View) -> NDArray[np.bool_]:
        """Whether their meshes have moved, (H, W)."""
        moved = (now.object_to_world != previous.object_to_world).any(axis=(1, 2))
        return np.concatenate([[False], moved])[self.mesh_id]


def tracked_hits(stage: Stage, *sample: Any) -> list[Any]:
    """What `hits_of_samples` returns, as Dr.Jit's arrays."""
    scene = stage.mitsuba_scene
    si, light, _, infinite, faces, bsdf_sample = first_bounce(stage, *sample)
    blocker = scene.ray_intersect(si.spawn_ray_to(light.p), mi.RayFlags.Minimal, coherent=False, active=faces)
    glossy = mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.GlossyReflection)
    reflects = (bsdf_sample.pdf > 0) & (glossy | mi.has_flag(bsdf_sample.sampled_type, mi.BSDFFlags.DeltaReflection))
    onward = si.spawn_ray(si.to_world(bsdf_sample.wo))
    reflected = scene.ray_intersect(onward, mi.RayFlags.Minimal, coherent=False, active=reflects)
    shape = registry_index(light.emitter.get_shape())
    light_id = dr.gather(mi.UInt32, stage.mesh_id_of_shape, shape, faces & ~infinite)
    hit = reflected.is_valid()
    return [
        *(blocker.p, stage.mesh_id(blocker), blocker.is_valid()),
        *(dr.select(infinite, light.d, light.p), light_id, ~infinite),
        *(dr.select(hit, reflected.p, onward.d), stage.mesh_id(reflected), hit, reflects),
        si.n,
    ]


def hits_of_samples(
    tracer: PathTracer, view: View, draw: SampleRange
) -> tuple[MeshPoint, MeshPoint, MeshPoint, NDArray[np.bool_], Array]:
    """Hits of the shadow ray and the reflected ray of each pixel's first sample of `draw`, posed for `view`.

    (the blocker between surface and light, not finite where there is none; the light; what is reflected, and where
    (H, W); the geometric normal of the surface itself (H, W, 3)).
    """
    stage = tracer.stage
    values = of_sample(tracked_hits, tracer, view, draw.seed, draw.first)
    arrays = [stage.image(value) for value in values]

    def mesh_point(point: NDArray[Any], mesh_id: NDArray[Any], finite: NDArray[Any]) -> MeshPoint:
        in_world = point * np.where(finite, stage.unit, 1.0)
        return MeshPoint(in_world, finite[..., 0].astype(bool), mesh_id[..., 0])

    blocking, lighting, shown = (mesh_point(*arrays[i : i + 3]) for i in (0, 3, 6))
    return blocking, lighting, shown, arrays[9][..., 0].astype(bool), arrays[10].astype(np.float64)


def mirror_image(point: Array, finite: NDArray[np.bool_], mirror: Array, normal: Array) -> Array:
    """The points' images (H, W, 3) behind a mirror through the points `mirror` with that unit normal."""
    from_mirror = point - np.where(finite[..., None], mirror, 0)
    return point - 2 * np.sum(from_mirror * normal, axis=-1, keepdims=True) * normal


def shadow_of(blocker: Array, light: Array, infinite: NDArray[np.bool_], plane: Array, normal: Array) -> Array:
    """Where rays from `light` through `blocker` hit planes behind it, all (H, W, 3); NaN where they do not."""
    along = np.where(infinite[..., None], -light, blocker - light)
    with np.errstate(all="ignore"):
        steps = np.sum((plane - blocker) * normal, axis=-1) / np.sum(along * normal, axis=-1)
        return blocker + np.where(steps > 0, steps, np.nan)[..., None] * along


def tracked_motion(tracer: PathTracer, draw: SampleRange, frame: Arrays, now: View, previous: View) -> dict[str, Array]:
    """The channels `shadow_motion` and `reflection_motion` (H, W, 2), in pixels, of a frame with depth and motion.

    shadow_motion: to where, in the previous frame, the blocker cast its shadow from the same point on the light onto
    the plane of the surface. reflection_motion: the motion of the mirror image of what the surface reflects. A rough
    surface reflects other points than a mirror would; its image of them moves as the mirror's.

    They are `motion` where nothing blocks or is reflected and where a point is behind a camera; so is shadow_motion
    where nothing but the camera moves.
    """
    blocker, light, reflected, reflects, own_normal = hits_of_samples(tracer, now, draw)
    motion = frame["motion"].astype(np.float64)
    depth = frame["depth"][..., 0].astype(np.float64)
    centres = pixel_centres(*depth.shape)
    surface = MeshPoint(unproject(centres, depth, now), depth > 0, frame["mesh_id"][..., 0])
    plane = surface.in_previous(now, previous)
    normal = move(surface.point + own_normal, surface.mesh_id, now, previous) - plane
    blocker_then, light_then = (point.in_previous(now, previous) for point in (blocker, light))
    shadow = shadow_of(blocker_then, light_then, ~light.finite, plane, normal)
    shadowed = blocker.finite & np.isfinite(shadow).all(axis=-1)
    shadowed &= np.any([point.moved(now, previous) for point in (surface, blocker, light)], axis=0)
    then = project(np.where(shadowed[..., None], shadow, plane), shadowed, previous)
    shadowed &= np.abs(then).max(axis=-1) < FAR_OUTSIDE

    image = mirror_image(reflected.point, reflected.finite, surface.point, own_normal)
    image_then = mirror_image(reflected.in_previous(now, previous), reflected.finite, plane, normal)
    here = project(image, reflected.finite, now)
    there = project(image_then, reflected.finite, previous)
    visible = reflects & (np.abs(np.concatenate([here, there], axis=-1)).max(axis=-1) < FAR_OUTSIDE)
    return {
        "shadow_motion": np.where(shadowed[..., None], then - centres, motion),
        "reflection_motion": np.where(visible[..., None], there - here, motion),
    }
