"""What shades a surface and what it reflects, followed into the previous frame (Zeng et al. 2021).

"Temporally Reliable Motion Vectors for Real-time Ray Tracing": shadows and reflections do not move as the surfaces on
which they are seen, so their motion vectors follow their cause: the blocker that the shadow ray meets, and the point
that the reflected ray hits. Each pixel has those of its first sample in the first noise realisation.
"""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type, call-overload, operator, union-attr"

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.first_bounce import first_bounce
from render.materials import registry_index
from render.path import PathTracer
from scenes.camera import FAR_OUTSIDE, Array, View, move, pixel_centres, project, unproject


class Cause(NamedTuple):
    """Points in the world that move along with meshes."""

    point: Array  # (H, W, 3); a direction where it is not `finite`
    finite: NDArray[np.bool_]  # (H, W)
    mesh_id: NDArray[np.integer]  # (H, W), 0 for what stays

    def then(self, now: View, previous: View) -> Array:
        """The points (H, W, 3) in the previous frame."""
        return move(self.point, self.mesh_id, now, previous)

    def moved(self, now: View, previous: View) -> NDArray[np.bool_]:
        """Whether their meshes stood elsewhere then, (H, W)."""
        moved = (now.object_to_world != previous.object_to_world).any(axis=(1, 2))
        return np.concatenate([[False], moved])[self.mesh_id]


class Causes(NamedTuple):
    """What the first sample of each pixel has met."""

    blocker: Cause  # between surface and light; not finite where there is none
    light: Cause
    reflected: Cause  # where the surface `reflects` (H, W)
    reflects: NDArray[np.bool_]
    normal: Array  # (H, W, 3), geometric, of the surface itself


def causes(tracer: PathTracer, view: View, seed: int, first: int) -> Causes:
    """What the samples met that `tracer.radiance` draws with this seed. The stage must be posed for `view`'s frame."""
    stage = tracer.stage
    scene = stage.mitsuba_scene
    si, light, _, endless, faces, sample = first_bounce(tracer, view, seed, first)
    blocker = scene.ray_intersect(si.spawn_ray_to(light.p), mi.RayFlags.Minimal, coherent=False, active=faces)
    glossy = mi.has_flag(sample.sampled_type, mi.BSDFFlags.GlossyReflection)
    mirrors = (sample.pdf > 0) & (glossy | mi.has_flag(sample.sampled_type, mi.BSDFFlags.DeltaReflection))
    onward = si.spawn_ray(si.to_world(sample.wo))
    reflected = scene.ray_intersect(onward, mi.RayFlags.Minimal, coherent=False, active=mirrors)
    lamp = dr.gather(mi.UInt32, stage.mesh_id_of_shape, registry_index(light.emitter.get_shape()), faces & ~endless)

    met = reflected.is_valid()
    values: list[Any] = [
        *(blocker.p, stage.mesh_id(blocker), blocker.is_valid()),
        *(dr.select(endless, light.d, light.p), lamp, ~endless),
        *(dr.select(met, reflected.p, onward.d), stage.mesh_id(reflected), met, mirrors),
        si.n,
    ]
    dr.eval(values)
    arrays = [stage.image(value) for value in values]

    def cause(point: NDArray[Any], mesh_id: NDArray[Any], finite: NDArray[Any]) -> Cause:
        in_world = point * np.where(finite, stage.unit, 1.0)
        return Cause(in_world, finite[..., 0].astype(bool), mesh_id[..., 0])

    return Causes(
        blocker=cause(*arrays[:3]),
        light=cause(*arrays[3:6]),
        reflected=cause(*arrays[6:9]),
        reflects=arrays[9][..., 0].astype(bool),
        normal=arrays[10].astype(np.float64),
    )


def mirrored(point: Array, finite: NDArray[np.bool_], mirror: Array, normal: Array) -> Array:
    """The points' images (H, W, 3) behind a mirror through the points `mirror` with that unit normal."""
    from_mirror = point - np.where(finite[..., None], mirror, 0)
    return point - 2 * np.sum(from_mirror * normal, axis=-1, keepdims=True) * normal


def shadow_of(blocker: Array, light: Array, endless: NDArray[np.bool_], plane: Array, normal: Array) -> Array:
    """Where rays from `light` through `blocker` meet planes behind it, all (H, W, 3); NaN where they do not."""
    along = np.where(endless[..., None], -light, blocker - light)
    with np.errstate(all="ignore"):
        steps = np.sum((plane - blocker) * normal, axis=-1) / np.sum(along * normal, axis=-1)
        return blocker + np.where(steps > 0, steps, np.nan)[..., None] * along


def surface_of(frame: dict[str, NDArray[Any]], now: View) -> Cause:
    """What the pixel centres show."""
    depth = frame["depth"][..., 0].astype(np.float64)
    return Cause(unproject(pixel_centres(*depth.shape), depth, now), depth > 0, frame["mesh_id"][..., 0])


def tracked_motion(met: Causes, frame: dict[str, NDArray[Any]], now: View, previous: View) -> dict[str, Array]:
    """The channels `shadow_motion` and `reflection_motion` (H, W, 2), in pixels, of a frame with depth and motion.

    shadow_motion: to where, in the previous frame, the blocker threw its shadow by the same point of the light onto the
    plane in which the surface lay.
    reflection_motion: how the mirror image of what the surface reflects has moved. A rough surface reflects other
    points than a mirror would; its picture of them moves as the mirror's.

    They are `motion` where nothing blocks or is reflected and where a place lies behind a camera; so is shadow_motion
    where nothing but the camera moves.
    """
    motion = frame["motion"].astype(np.float64)
    surface = surface_of(frame, now)
    plane = surface.then(now, previous)
    normal = move(surface.point + met.normal, surface.mesh_id, now, previous) - plane
    light = met.light.then(now, previous)
    shadow = shadow_of(met.blocker.then(now, previous), light, ~met.light.finite, plane, normal)
    falls = met.blocker.finite & np.isfinite(shadow).all(axis=-1)
    falls &= np.any([cause.moved(now, previous) for cause in (surface, met.blocker, met.light)], axis=0)
    was = project(np.where(falls[..., None], shadow, plane), falls, previous)
    falls &= np.abs(was).max(axis=-1) < FAR_OUTSIDE

    reflected = met.reflected
    image = mirrored(reflected.point, reflected.finite, surface.point, met.normal)
    image_then = mirrored(reflected.then(now, previous), reflected.finite, plane, normal)
    here = project(image, reflected.finite, now)
    there = project(image_then, reflected.finite, previous)
    seen = met.reflects & (np.abs(np.concatenate([here, there], axis=-1)).max(axis=-1) < FAR_OUTSIDE)
    return {
        "shadow_motion": np.where(falls[..., None], was - pixel_centres(*falls.shape), motion),
        "reflection_motion": np.where(seen[..., None], there - here, motion),
    }
