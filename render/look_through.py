"""What mirrors and smooth glass show: chains of specular events, from the eye to the first surface of another kind.

That surface is described as if it stood behind the mirror or in the window: it has edges, textures and motion like any
other, so that denoisers need no special case for it. A pixel of glass shows two pictures, of which each has such a
description (after the path-space decomposition of Zimmer et al. 2015): one by the branch that samples take more often
at the first glass on the way, one by the other. Behind it both take the more frequent one.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from render.backend import dr, mi
from render.loading import upload
from render.materials import is_in
from render.stage import Stage
from scenes.camera import View

MAX_MIRRORS = 4  # along a ray
LONGEST_CHAIN = 12  # in scenes with glass
# Where what a surface reflects is blurred more, its own guides serve denoisers better (docs/experiments.md). In pixels,
# for images of up to SMALL_HEIGHT rows; larger ones have more pixels between the edges of the same picture.
MAX_BLUR = 0.75
SMALL_HEIGHT = 180
ALMOST_ONE = 1 - 2.0**-24  # as a random number: it chooses transmission wherever there is any


@dataclass
class Sight:
    """What rays hit behind all mirrors and glass that show it sharply, or the last of these where it shows the sky."""

    si: mi.SurfaceInteraction3f
    ray: mi.Ray3f  # the last one
    beyond: mi.Float  # apparent length of the path after the first event in Mitsuba's units; 0 without one
    spread: mi.Float  # by which rays diverge, in radians: twice the GGX alpha of each mirror
    blur: mi.Float  # how far they have diverged, in Mitsuba's units
    tint: mi.Color3f  # the product of all mirrors' albedos, and of the weights of samples that take these branches
    axes: tuple[mi.Vector3f, mi.Vector3f, mi.Vector3f]  # the world's, turned by all events from first to last
    goes_on: mi.Bool  # whether the last event has led to another surface
    exact: mi.Bool  # whether all events so far are perfectly specular
    index: mi.Float  # of refraction, where the last ray runs
    glass: mi.Bool  # whether there is glass in the chain
    reflectance: mi.Float  # the probability of reflection at the glass where samples split; 0 without one

    @staticmethod
    def along(ray: mi.Ray3f, si: mi.SurfaceInteraction3f) -> "Sight":
        """What primary rays hit."""
        axes = (mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0), mi.Vector3f(0, 0, 1))
        zero, yes = mi.Float(0), mi.Bool(si.is_valid())
        return Sight(si, ray, zero, zero, zero, mi.Color3f(1), axes, yes, yes, mi.Float(1), mi.Bool(False), zero)


def glass_event(
    glass: mi.Bool, sight: Sight, rarer_first: mi.Bool
) -> tuple[mi.Bool, mi.Vector3f, mi.Bool, mi.Color3f, mi.Float, mi.Float]:
    """The more frequent branch at smooth glass, or if `rarer_first` at the first glass on the way the other one.

    (whether there is glass, the direction behind it, whether it reflects, its tint, the index of refraction behind the
    surface over that before it, the probability of reflection).
    """
    si: Any = sight.si  # Mitsuba's stubs know its types by two names
    bsdf = si.bsdf()
    here = is_in(glass, bsdf, sight.goes_on)
    context = mi.BSDFContext()
    reflection, reflected_weight = bsdf.sample(context, si, 0, mi.Point2f(0.5), here)
    transmission, transmitted_weight = bsdf.sample(context, si, ALMOST_ONE, mi.Point2f(0.5), here)
    chance = dr.select(mi.has_flag(reflection.sampled_type, mi.BSDFFlags.DeltaReflection), reflection.pdf, 0)
    reflects = (chance > 0.5) ^ (rarer_first & ~sight.glass)
    sample = dr.select(reflects, reflection, transmission)
    weight = dr.select(reflects, reflected_weight, transmitted_weight)
    return here, si.to_world(sample.wo), reflects, weight, sample.eta, chance


def turned(axis: mi.Vector3f, before: mi.Vector3f, after: mi.Vector3f) -> mi.Vector3f:
    """An axis, by the smallest rotation from the direction `before` to `after`; these are less than 180° apart."""
    pole = dr.cross(before, after)
    cosine = dr.dot(before, after)
    return cosine * axis + dr.cross(pole, axis) + pole * dr.dot(pole, axis) / (1 + cosine)


def flipped(axis: mi.Vector3f, normal: mi.Vector3f) -> mi.Vector3f:
    return axis - 2 * dr.dot(axis, normal) * normal


def one_further(
    stage: Stage, sight: Sight, eye_distance: mi.Float, max_angle: mi.Float, rarer_first: mi.Bool, may_split: mi.Bool
) -> Sight:
    """What the last surfaces show; unchanged where they show nothing, a ray misses or the picture is blurred.

    `eye_distance` is the length of primary rays, `max_angle` the largest blur in radians, as seen from the eye.
    """
    here: Any = sight.si
    is_mirror, tint, alpha = stage.materials.mirror_at(here)
    normal = stage.normals.evaluate(here, is_mirror)
    direction = flipped(sight.ray.d, normal)
    axes = [flipped(axis, normal) for axis in sight.axes]
    shows, index, reflectance, glass = is_mirror, sight.index, sight.reflectance, sight.glass
    if stage.glass is not None:
        is_glass, behind, reflects, glass_tint, eta, chance = glass_event(stage.glass, sight, rarer_first)
        shows = shows | is_glass
        tint = dr.select(is_glass, glass_tint, tint)
        alpha = dr.select(is_glass, 0, alpha)
        direction = dr.select(is_glass, behind, direction)
        index = dr.select(is_glass, index * eta, index)
        splits = is_glass & ~glass & sight.exact & may_split
        reflectance = dr.select(splits, chance, reflectance)
        glass = glass | is_glass
        across = dr.normalize(direction - sight.ray.d)
        for number, axis in enumerate(sight.axes):
            bent = dr.select(reflects, flipped(axis, across), turned(axis, sight.ray.d, direction))
            axes[number] = dr.select(is_glass, bent, axes[number])
    exact = sight.exact & is_in(stage.specular, here.bsdf(), here.is_valid())

    onward = stage.past_cutouts(here.spawn_ray(direction))
    there = stage.mitsuba_scene.ray_intersect(onward, mi.RayFlags.All, coherent=False, active=shows)
    step = dr.norm(there.p - here.p)
    beyond = sight.beyond + step / index
    spread = sight.spread + 2 * alpha
    blur = sight.blur + spread * step
    is_sharp = blur < max_angle * (eye_distance + beyond)
    goes_on = sight.goes_on & shows & there.is_valid() & is_sharp
    x, y, z = axes
    shown = Sight(
        there, onward, beyond, spread, blur, sight.tint * tint, (x, y, z), goes_on, exact, index, glass, reflectance
    )
    result: Sight = dr.select(goes_on, shown, replace(sight, goes_on=goes_on, reflectance=reflectance))
    return result


def surface_channels(stage: Stage, sight: Sight) -> dict[str, dr.AnyArray]:
    """The channels of a surface as the eye sees it, but for depth, by name."""
    valid = sight.si.is_valid()
    normal = stage.normals.evaluate(sight.si, valid)
    normal = dr.select(dr.dot(normal, sight.ray.d) > 0, -normal, normal)
    albedo, roughness = stage.materials.evaluate(sight.si, valid)
    return {
        "normal": dr.select(valid, mi.Vector3f(*(dr.dot(axis, normal) for axis in sight.axes)), mi.Vector3f(0)),
        "albedo": sight.tint * albedo,
        "roughness": roughness,
        "mesh_id": stage.mesh_id(sight.si),
    }


@dataclass
class Shown:
    """What primary rays show behind mirrors and glass."""

    channels: dict[str, dr.AnyArray]  # but for depth
    length: mi.Float  # apparent, of the whole path in Mitsuba's units; 0 where the primary ray hits nothing
    point: mi.Point3f  # where the path ends
    through_glass: mi.Bool
    reflectance: mi.Float  # as in Sight


def shown(stage: Stage, ray: mi.Ray3f, max_angle: mi.Float, rarer_first: mi.Bool, max_splits: mi.UInt32) -> Shown:
    """As `look_through`: the loop over events runs in the kernel."""
    si: Any = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    longest = MAX_MIRRORS if stage.glass is None else LONGEST_CHAIN

    def step(number: mi.UInt32, sight: Sight) -> tuple[mi.UInt32, Sight]:
        return number + 1, one_further(stage, sight, si.t, max_angle, rarer_first, number < max_splits)

    start = mi.UInt32(0), Sight.along(ray, si)
    sight = dr.while_loop(start, lambda number, sight: (number < longest) & sight.goes_on, step)[1]
    length = dr.select(si.is_valid(), si.t + sight.beyond, 0)
    through_glass = sight.glass & (sight.beyond > 0)
    return Shown(surface_channels(stage, sight), length, sight.si.p, through_glass, sight.reflectance)


def look_through(stage: Stage, view: View, ray: mi.Ray3f, rarer_first: bool = False, max_splits: int = 1) -> Shown:
    """What primary rays of `view` show behind mirrors and glass, with the stage posed for its frame.

    Rays split at the first glass, if it is among the first `max_splits` events. rarer_first: follow the rarer branch
    there.
    """
    max_blur = MAX_BLUR * max(1, stage.height / SMALL_HEIGHT)
    max_angle = upload(max_blur / np.abs(view.K[:1, 0]))
    return stage.replay(shown, ray, max_angle, dr.opaque(mi.Bool, rarer_first), dr.opaque(mi.UInt32, max_splits))
