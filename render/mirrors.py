"""What rays see by way of mirrors.

A flat mirror shows another room behind it. Described as what stands there, a picture in a mirror has edges, textures
and motion like any other, and denoisers need to know nothing of mirrors.
"""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type, assignment, misc, operator, union-attr"

from dataclasses import dataclass

from render.backend import dr, mi
from render.materials import SMOOTH
from render.stage import Stage

MOST_MIRRORS = 4  # that a ray is followed by


@dataclass
class Seen:
    """What rays meet in the end. Where a mirror shows nothing but sky, that is the mirror."""

    si: mi.SurfaceInteraction3f
    ray: mi.Ray3f  # the last one
    beyond: mi.Float  # Mitsuba's units from the first mirror on; 0 where there was none
    tint: mi.Color3f  # the product of all mirrors' albedos
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]  # the world's, as the mirrors turn them from first to last

    @staticmethod
    def directly(si: mi.SurfaceInteraction3f, ray: mi.Ray3f) -> "Seen":
        """What rays from the eye meet first."""
        axes = (mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
        return Seen(si, ray, mi.Float(0), mi.Color3f(1), axes)

    def in_mirrors(self, normal: mi.Vector3f) -> mi.Vector3f:
        """A direction (3,) in the world as the mirrors show it."""
        return mi.Vector3f(*(dr.dot(axis, normal) for axis in self.axes))


def mirror_at(stage: Stage, si: mi.SurfaceInteraction3f) -> tuple[mi.Bool, mi.Color3f]:
    """Whether there is a mirror, and its albedo."""
    hit = si.is_valid()
    flags = si.bsdf().flags()
    faces = (si.wi.z > 0) | mi.has_flag(flags, mi.BSDFFlags.BackSide)
    scatters = mi.has_flag(flags, mi.BSDFFlags.Diffuse) | mi.has_flag(flags, mi.BSDFFlags.Transmission)
    albedo, alpha = stage.materials.evaluate(si, hit)
    return hit & faces & ~scatters & (alpha < SMOOTH), albedo


def look_through(stage: Stage, seen: Seen) -> Seen:
    """What rays see in the end that see these things first: those, or what a chain of mirrors there shows."""
    for _ in range(MOST_MIRRORS):
        mirror, albedo = mirror_at(stage, seen.si)
        if not dr.any(mirror):
            break
        seen = reflected(stage, seen, mirror, albedo)
    return seen


def reflected(stage: Stage, seen: Seen, mirror: mi.Bool, albedo: mi.Color3f) -> Seen:
    """The same, but what each `mirror` shows that shows something."""
    here = seen.si
    normal = stage.normals.evaluate(here, mirror)

    def flipped(direction: mi.Vector3f) -> mi.Vector3f:
        return direction - 2 * dr.dot(direction, normal) * normal

    onward = stage.past_holes(here.spawn_ray(flipped(seen.ray.d)))
    there = stage.mitsuba_scene.ray_intersect(onward, mi.RayFlags.All, coherent=False, active=mirror)
    distance = seen.beyond + dr.norm(there.p - here.p)
    x, y, z = map(flipped, seen.axes)
    shown = Seen(there, onward, distance, seen.tint * albedo, (x, y, z))
    result: Seen = dr.select(mirror & there.is_valid(), shown, seen)
    dr.eval(result)
    return result
