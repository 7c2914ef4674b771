"""What mirrors and smooth glass show: chains of specular events, from the eye to the first surface of another kind.

That surface is described as if it stood behind the mirror or in the window: it has edges, textures and motion like any
other, so that denoisers need no special case for it. A pixel of glass shows two pictures, of which each has such a
description (after the path-space decomposition of Zimmer et al. 2015): one by the branch that samples take more often
at the first glass on the way, one by the other. Behind it both take the more frequent one.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple
from weakref import finalize, proxy

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.loading import columns, upload
from render.palette import palette
from render.specular import BsdfSet
from render.stage import Stage
from scenes.camera import FAR_OUTSIDE, Array, View, move, pixel_centres

MAX_MIRRORS = 4  # along a ray
LONGEST_CHAIN = 12  # in scenes with glass
# Of what a surface reflects, in pixels: where it is blurred more, its own guides serve denoisers better.
MAX_BLUR = 0.75
NEWTON_STEPS = 6
PROBE = 0.25  # px between the rays from which derivatives are estimated
MAX_STEP = 8.0  # px
EXACT, FOUND_WITHIN = 0.02, 0.5  # px
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

    def turned_back(self, normal: mi.Vector3f) -> mi.Vector3f:
        """A world direction (3,) as the eye sees it."""
        return mi.Vector3f(*(dr.dot(axis, normal) for axis in self.axes))


class GlassEvent(NamedTuple):
    """A branch at smooth glass, where there is any (`here`)."""

    here: mi.Bool
    direction: mi.Vector3f
    reflects: mi.Bool
    tint: mi.Color3f
    eta: mi.Float  # index of refraction behind the surface over that before it
    reflectance: mi.Float  # the probability of reflection


def glass_event(glass: BsdfSet, sight: Sight, rarer_first: mi.Bool) -> GlassEvent:
    """The more frequent branch, or if `rarer_first` at the first glass on the way the other one."""
    si: Any = sight.si  # Mitsuba's stubs know its types by two names
    bsdf = si.bsdf()
    here = glass.at(bsdf, sight.goes_on)
    context = mi.BSDFContext()
    reflection, reflected_weight = bsdf.sample(context, si, 0, mi.Point2f(0.5), here)
    transmission, transmitted_weight = bsdf.sample(context, si, ALMOST_ONE, mi.Point2f(0.5), here)
    chance = dr.select(mi.has_flag(reflection.sampled_type, mi.BSDFFlags.DeltaReflection), reflection.pdf, 0)
    reflects = (chance > 0.5) ^ (rarer_first & ~sight.glass)
    sample = dr.select(reflects, reflection, transmission)
    weight = dr.select(reflects, reflected_weight, transmitted_weight)
    return GlassEvent(here, si.to_world(sample.wo), reflects, weight, sample.eta, chance)


def turned(axis: mi.Vector3f, before: mi.Vector3f, after: mi.Vector3f) -> mi.Vector3f:
    """An axis, by the smallest rotation from the direction `before` to `after`; these are less than 180° apart."""
    pole = dr.cross(before, after)
    cosine = dr.dot(before, after)
    return cosine * axis + dr.cross(pole, axis) + pole * dr.dot(pole, axis) / (1 + cosine)


def flipped(axis: mi.Vector3f, normal: mi.Vector3f) -> mi.Vector3f:
    return axis - 2 * dr.dot(axis, normal) * normal


def one_further(
    stage: Stage, sight: Sight, eye_distance: mi.Float, focal: mi.Float, rarer_first: mi.Bool, may_split: mi.Bool
) -> Sight:
    """What the last surfaces show; unchanged where they show nothing, a ray misses or the picture is blurred.

    `eye_distance` is the length of primary rays, `focal` the focal length in pixels.
    """
    here: Any = sight.si
    is_mirror, tint, alpha = stage.materials.mirror_at(here)
    normal = stage.normals.evaluate(here, is_mirror)
    direction = flipped(sight.ray.d, normal)
    axes = [flipped(axis, normal) for axis in sight.axes]
    shows, index, reflectance, glass = is_mirror, sight.index, sight.reflectance, sight.glass
    if stage.glass is not None:
        event = glass_event(stage.glass, sight, rarer_first)
        shows = shows | event.here
        tint = dr.select(event.here, event.tint, tint)
        alpha = dr.select(event.here, 0, alpha)
        direction = dr.select(event.here, event.direction, direction)
        index = dr.select(event.here, index * event.eta, index)
        splits = event.here & ~glass & sight.exact & may_split
        reflectance = dr.select(splits, event.reflectance, reflectance)
        glass = glass | event.here
        across = dr.normalize(direction - sight.ray.d)
        for number, axis in enumerate(sight.axes):
            bent = dr.select(event.reflects, flipped(axis, across), turned(axis, sight.ray.d, direction))
            axes[number] = dr.select(event.here, bent, axes[number])
    exact = sight.exact & stage.specular.at(here.bsdf(), here.is_valid())

    onward = stage.past_cutouts(here.spawn_ray(direction))
    there = stage.mitsuba_scene.ray_intersect(onward, mi.RayFlags.All, coherent=False, active=shows)
    step = dr.norm(there.p - here.p)
    beyond = sight.beyond + step / index
    spread = sight.spread + 2 * alpha
    blur = sight.blur + spread * step
    is_sharp = blur * focal < MAX_BLUR * (eye_distance + beyond)
    goes_on = sight.goes_on & shows & there.is_valid() & is_sharp
    x, y, z = axes
    shown = Sight(
        there, onward, beyond, spread, blur, sight.tint * tint, (x, y, z), goes_on, exact, index, glass, reflectance
    )
    result: Sight = dr.select(goes_on, shown, replace(sight, goes_on=goes_on, reflectance=reflectance))
    return result


def event_of(stage: Stage) -> Callable[..., Sight]:
    """`one_further` on a stage in its pose, recorded where Dr.Jit can: tracing it takes longer than running it."""
    if not stage.freezes or stage.has_cutouts:
        return partial(one_further, stage)
    if stage.event_pose != stage.poses:
        state = (palette(), stage.mitsuba_scene, stage.materials.state(), stage.specular, stage.glass)
        own = proxy(stage)  # Mitsuba cannot free a scene during a recording, when the collector of cycles might
        stage.event = dr.freeze(lambda *arguments: one_further(own, *arguments), state_fn=lambda *_, **__: state)
        stage.event_pose = stage.poses
        finalize(stage, stage.event.clear)  # else its recordings would keep the scene
    return stage.event


def look_through(
    stage: Stage, view: View, ray: mi.Ray3f, si: Any, rarer_first: bool = False, max_splits: int = 1
) -> Sight:
    """What mirrors and glass at the ends `si` of primary rays show.

    Rays split at the first glass, if it is among the first `max_splits` events. rarer_first: follow the rarer branch
    there.
    """
    sight = Sight.along(ray, si)
    focal = upload(np.abs(view.K[:1, 0]))
    follow = event_of(stage)
    dr.make_opaque(sight, si.t)  # as after an event: literals would need a recording of their own
    for number in range(MAX_MIRRORS if stage.glass is None else LONGEST_CHAIN):
        flags = dr.opaque(mi.Bool, rarer_first), dr.opaque(mi.Bool, number < max_splits)
        sight = follow(sight, si.t, focal, *flags)
        dr.eval(sight)
        if not dr.any(sight.goes_on):
            break
    return sight


class TracedChains(NamedTuple):
    """The chains of specular events through `pixels` (N, 2), by the rarer branch at the first glass or the other."""

    pixels: Array
    rarer_first: bool
    ends: Array  # (N, 3), world
    mesh_id: NDArray[np.integer]  # (N,), at the end
    through_glass: NDArray[np.bool_]  # (N,)


class NewtonStep(NamedTuple):
    step: Array  # (N, 2), px
    off: Array  # (N,), about how many pixels the start is off; infinite on another mesh


def chains_at(stage: Stage, view: View, pixels: Array, rarer_first: bool) -> TracedChains:
    """The chains through `pixels` (N, 2), for a stage posed for `view`'s frame."""
    ray = stage.rays(view, pixels)
    si = stage.mitsuba_scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
    sight = look_through(stage, view, ray, si, rarer_first)
    mesh_id = stage.mesh_id(sight.si)
    through_glass = sight.glass & (sight.beyond > 0)
    dr.eval(sight.si.p, mesh_id, through_glass)
    ends = columns(sight.si.p).astype(np.float64) * stage.unit
    return TracedChains(pixels, rarer_first, ends, np.array(mesh_id), np.array(through_glass))


def chains_through_glass(stage: Stage, view: View, rarer_first: bool) -> TracedChains:
    """Those through all pixel centres."""
    return chains_at(stage, view, pixel_centres(stage.height, stage.width).reshape(-1, 2), rarer_first)


def newton_step(
    stage: Stage, view: View, place: Array, rarer_first: bool, target: Array, mesh_id: NDArray[np.integer]
) -> NewtonStep:
    """From pixels `place` (N, 2) towards those whose chains end at `target` (N, 3), on the meshes `mesh_id` (N,)."""
    probes = np.stack([place, place + np.array([PROBE, 0]), place + np.array([0, PROBE])])
    there = chains_at(stage, view, probes.reshape(-1, 2), rarer_first)
    ends = there.ends.reshape(3, -1, 3)
    across, down = (ends[1:] - ends[0]) / PROBE  # world units a pixel
    error = target - ends[0]
    xx, xy, yy = ((a * b).sum(axis=-1) for a, b in ((across, across), (across, down), (down, down)))
    x, y = ((a * error).sum(axis=-1) for a in (across, down))
    step = np.stack([yy * x - xy * y, xx * y - xy * x], axis=-1) / np.maximum(xx * yy - xy**2, 1e-30)[:, None]
    same = (there.mesh_id.reshape(3, -1) == mesh_id).all(axis=0)
    pixels_off = np.linalg.norm(error, axis=-1) / np.sqrt(np.maximum(np.maximum(xx, yy), 1e-30))
    return NewtonStep(step.clip(-MAX_STEP, MAX_STEP), np.where(same, pixels_off, np.inf))


def traced_motion(stage: Stage, chains: TracedChains, motion: Array, now: View, previous: View) -> Array:
    """`motion` (H, W, 2), in pixels, with that of what glass shows traced, for a stage posed for the previous frame.

    What glass shows is where the same branch led to the same surface point then. From the pixel that the virtual point
    behind the glass moves to, Newton's method on the traced map finds it. Where it does not, motion is FAR_OUTSIDE.
    """
    traced = motion.reshape(-1, 2).copy()
    (active,) = np.nonzero(chains.through_glass)
    place = chains.pixels + traced
    traced[active] = FAR_OUTSIDE
    target = move(chains.ends, chains.mesh_id, now, previous)
    for _ in range(NEWTON_STEPS):
        if len(active):
            step, off = newton_step(
                stage, previous, place[active], chains.rarer_first, target[active], chains.mesh_id[active]
            )
            found = active[off < FOUND_WITHIN]
            place[active] += np.where((off < EXACT)[:, None], 0, step)
            traced[found] = (place - chains.pixels)[found]
            active = active[(off >= EXACT) & np.isfinite(off)]
    return traced.reshape(motion.shape)
