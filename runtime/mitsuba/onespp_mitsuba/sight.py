"""What rays show: first hits, or what mirrors and smooth glass show, as if it stood behind them.

At glass, rays follow the branch that samples take more often.
"""

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from .bsdfs import Surface, Surfaces
from .colours import is_scalar, mean_rgb

MAX_MIRRORS = 4  # along a ray
LONGEST_CHAIN = 12  # in scenes with glass
MAX_CUTOUTS = 32  # that a ray passes
CUTOUT = 0.999  # least transmission of one
MAX_MIRROR_ALPHA = 0.1  # GGX; rougher surfaces show nothing sharply but what touches them
MAX_BLUR = 0.75  # of what a surface reflects, in pixels: where it is blurred more, its own guides serve better
ALMOST_ONE = 1 - 2.0**-24  # as a random number: it chooses transmission wherever there is any


@dataclass
class Sight:
    """What a ray hits after all events that show it sharply, or the last of these where it shows the sky."""

    si: Any
    ray: Any  # the last one
    beyond: Any  # apparent length of the path after the first event, in world units
    spread: Any  # by which rays diverge, in radians: twice the GGX alpha of each mirror
    blur: Any  # how far they have diverged, in world units
    tint: Any  # Color3f, the product of all albedos, and of the weights of glass
    x: Any  # the world's axes, turned by all events from first to last
    y: Any
    z: Any
    index: Any  # of refraction, where the last ray runs
    throughput: Any  # Color3f of perfect mirrors alone; 0 after any other event
    goes_on: Any  # whether the last event has led to another surface

    @staticmethod
    def along(scene: Any, ray: Any, active: Any) -> "Sight":
        """The first hit."""
        ray = past_cutouts(scene, ray, active)
        si = scene.ray_intersect(ray, mi.RayFlags.All, True, active)
        axes = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1)
        zero, one = mi.Float(0), mi.Color3f(1)
        return Sight(si, ray, zero, zero, zero, one, *axes, mi.Float(1), mi.Color3f(1), mi.Bool(si.is_valid()))


def negated(mask: Any) -> Any:
    """In scalar variants, masks are Python's, whose `~` is none."""
    return mask ^ True


def past_cutouts(scene: Any, ray: Any, active: Any) -> Any:
    """The rays from behind the cut-outs of masks that they hit first."""

    def step(number: Any, ray: Any, cutout: Any) -> tuple[Any, Any, Any]:
        si = scene.ray_intersect(ray, mi.RayFlags.All, True, cutout)
        hit = si.is_valid()
        passes = null_transmission(si, hit) > CUTOUT
        onward = si.spawn_ray(ray.d)
        ray.o = dr.select(hit & passes, onward.o, ray.o)
        return number + 1, ray, hit & passes

    start = mi.UInt32(0), mi.Ray3f(ray), mi.Bool(active)
    return dr.while_loop(start, lambda number, _, cutout: cutout & (number < MAX_CUTOUTS), step)[1]


def null_transmission(si: Any, hit: Any) -> Any:
    if is_scalar() and not hit:  # there is no BSDF to ask
        return 0.0
    return dr.min(mi.unpolarized_spectrum(si.bsdf().eval_null_transmission(si, hit)))


def flipped(axis: Any, normal: Any) -> Any:
    return axis - 2 * dr.dot(axis, normal) * normal


def turned(axis: Any, before: Any, after: Any) -> Any:
    """An axis, by the smallest rotation from the direction `before` to `after`; these are less than 180° apart."""
    pole, cosine = dr.cross(before, after), dr.dot(before, after)
    return cosine * axis + dr.cross(pole, axis) + pole * dr.dot(pole, axis) / (1 + cosine)


@dataclass
class Event:
    """A reflection or refraction that shows a surface, if it does."""

    shows: Any
    reflects: Any
    direction: Any
    tint: Any
    throughput: Any
    alpha: Any
    eta: Any  # index of refraction behind the surface over that before it


def event_at(sight: Sight, surface: Surface) -> Event:
    """At mirrors, rough ones up to MAX_MIRROR_ALPHA, and at smooth glass."""
    si, bsdf = sight.si, sight.si.bsdf()
    albedo, alpha, normal = surface
    flags = bsdf.flags()
    is_perfect = negated(mi.has_flag(flags, mi.BSDFFlags.Smooth)) & mi.has_flag(flags, mi.BSDFFlags.DeltaReflection)
    transmits = mi.has_flag(flags, mi.BSDFFlags.Transmission)
    is_mirror = negated(mi.has_flag(flags, mi.BSDFFlags.Diffuse) | transmits) & (alpha < MAX_MIRROR_ALPHA)
    faces = (si.wi.z > 0) | mi.has_flag(flags, mi.BSDFFlags.BackSide)
    # The lobes of perfect mirrors and glass: reflection by the first, transmission by the last random number.
    context, lobe = mi.BSDFContext(), mi.Point2f(0.5)
    reflection, reflected_weight = bsdf.sample(context, si, 0, lobe, is_perfect)
    transmission, transmitted_weight = bsdf.sample(context, si, ALMOST_ONE, lobe, is_perfect)
    is_delta = mi.has_flag(reflection.sampled_type, mi.BSDFFlags.DeltaReflection)
    chance = dr.select(is_delta, reflection.pdf, 0)
    reflects = negated(is_perfect) | (chance > 0.5)
    weight = mean_rgb(dr.select(reflects, reflected_weight, transmitted_weight))
    wo = dr.select(reflects, reflection.wo, transmission.wo)
    return Event(
        shows=si.is_valid() & ((is_mirror & faces) | (is_perfect & transmits)),
        reflects=reflects,
        direction=dr.select(is_perfect, si.to_world(wo), flipped(sight.ray.d, normal)),
        tint=dr.select(is_perfect & transmits, weight, albedo),
        throughput=dr.select(is_perfect & (chance > ALMOST_ONE), weight, mi.Color3f(0)),
        alpha=dr.select(is_perfect, 0, alpha),
        eta=dr.select(reflects, 1, transmission.eta),
    )


def one_further(scene: Any, surfaces: Surfaces, sight: Sight, eye_distance: Any, focal: Any) -> Sight:
    """What the last surfaces show; unchanged where they show nothing, a ray misses or the picture is blurred."""
    here = sight.si
    event = event_at(sight, surfaces.at(here))
    across = dr.normalize(event.direction - sight.ray.d)
    x, y, z = (
        dr.select(event.reflects, flipped(axis, across), turned(axis, sight.ray.d, event.direction))
        for axis in (sight.x, sight.y, sight.z)
    )
    index = sight.index * event.eta
    onward = past_cutouts(scene, here.spawn_ray(event.direction), event.shows)
    there = scene.ray_intersect(onward, mi.RayFlags.All, False, event.shows)
    length = dr.norm(there.p - here.p)
    beyond = sight.beyond + length / index
    spread = sight.spread + 2 * event.alpha
    blur = sight.blur + spread * length
    is_sharp = blur * focal < MAX_BLUR * (eye_distance + beyond)
    goes_on = sight.goes_on & event.shows & there.is_valid() & is_sharp
    tint, throughput = sight.tint * event.tint, sight.throughput * event.throughput
    shown = Sight(there, onward, beyond, spread, blur, tint, x, y, z, index, throughput, goes_on)
    result: Sight = dr.select(goes_on, shown, replace(sight, goes_on=goes_on))
    return result


def look_through(scene: Any, surfaces: Surfaces, first: Sight, eye: Any, focal: Any) -> Sight:
    """What is shown behind all mirrors and glass along the ray of a first hit; the focal length is in pixels."""
    eye_distance = dr.norm(first.si.p - eye)

    def step(number: Any, sight: Sight) -> tuple[Any, Sight]:
        return number + 1, one_further(scene, surfaces, sight, eye_distance, focal)

    longest = LONGEST_CHAIN if surfaces.has_glass else MAX_MIRRORS
    return dr.while_loop((mi.UInt32(0), first), lambda number, sight: (number < longest) & sight.goes_on, step)[1]
