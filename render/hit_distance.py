"""How far away is what the first rays of the noisy samples meet, and the light that shadow rays look for.

Axis-aligned filtering (Mehta et al. 2012, 2013) tells from it how fast light can vary along a surface.
"""

# In Mitsuba's stubs mi.Float and mi.Bool are other classes than those that its functions take and return.
# mypy: disable-error-code="arg-type, call-overload, operator"

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.first_bounce import first_bounce
from render.path import Draw, PathTracer
from scenes.camera import View

HIT_CHANNELS = ("hit_distance", "light_distance", "light_angle")
EVEN_VARIANCE = 1 / 12  # of an even distribution over [0, 1]


def met_by_sample(tracer: PathTracer, view: View, seed: int, index: int) -> NDArray[np.float64]:
    """(H, W, 4) of one sample a pixel, in Mitsuba's units: what hit_channels returns the means of; 0 for none."""
    stage = tracer.stage
    scene = stage.mitsuba_scene
    si, light, radiance, endless, faces, sample = first_bounce(tracer, view, seed, index)
    goes_on = si.is_valid() & (sample.pdf > 0)
    hit = scene.ray_intersect(si.spawn_ray(si.to_world(sample.wo)), mi.RayFlags.Minimal, coherent=False, active=goes_on)
    lit = faces & dr.any(radiance != 0)
    blocker = scene.ray_intersect(si.spawn_ray_to(light.p), mi.RayFlags.Minimal, coherent=False, active=lit)
    solid_angle = dr.select(light.delta, 0, 1 / (light.pdf * mi.Float(stage.lights.count)))
    values: list[Any] = [
        dr.select(goes_on & hit.is_valid(), dr.norm(hit.p - si.p), 0),
        dr.select(lit & blocker.is_valid(), dr.norm(blocker.p - si.p), 0),
        dr.select(lit & ~endless, light.dist, 0),
        dr.select(lit, dr.sqrt(EVEN_VARIANCE * solid_angle), 0),
    ]
    dr.eval(values)
    return np.concatenate([stage.image(value) for value in values], axis=-1).astype(np.float64)


def hit_channels(tracer: PathTracer, view: View, draws: Sequence[Draw]) -> dict[str, NDArray[np.float64]]:
    """HIT_CHANNELS (H, W, C) of the samples that `tracer.radiance` takes in all `draws`.

    The stage must be posed for the frame.

    Distances in world units, each the mean over the samples that met something, 0 where none did.

    hit_distance: from the surface to what the path hits first, and to what blocks the shadow ray.
    light_distance: from the surface to the point of a light that the shadow ray looks for, blocked or not; 0 for light
    that is infinitely far away.
    light_angle: that light's extent, the standard deviation of directions to it along an axis, in radians: of a square
    whose solid angle is 1 over the density of the direction. So all of a lamp's area counts, foreshortened as at the
    point, and of a sky only so much as is bright; 0 for points.
    """
    indices = ((seed, first + i) for seed, spp, first in draws for i in range(spp))
    samples = np.stack([met_by_sample(tracer, view, seed, index) for seed, index in indices])
    means = samples.sum(axis=0) / np.maximum((samples > 0).sum(axis=0), 1)
    means[..., :3] *= tracer.stage.unit
    return {"hit_distance": means[..., :2], "light_distance": means[..., 2:3], "light_angle": means[..., 3:]}
