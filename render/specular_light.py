"""Light seen by way of mirrors and glass, as free of noise as light seen directly.

Chains of perfectly specular events (delta lobes) need no random numbers: from each such surface every branch is
followed, and the light at its end, weighted by the chain's throughput, is emission. The path tracer leaves it out.
"""

import numpy as np
from numpy.typing import NDArray

from render.backend import dr, mi
from render.loading import columns, upload
from render.materials import is_in
from render.stage import Stage

MIN_BATCH = 4096  # rays traced together, since Dr.Jit 1.5 records anew for most smaller numbers


def branches_at_end(stage: Stage, *rays: mi.Float) -> tuple[mi.Color3f, list[tuple[mi.Bool, list[mi.Float]]]]:
    """(radiance from where `rays` end, for each delta lobe where it continues them; origin, direction, throughput)."""
    origin, direction, throughput = mi.Point3f(rays[:3]), mi.Vector3f(rays[3:6]), mi.Color3f(rays[6:])
    exists = dr.any(throughput > 0)
    si = stage.mitsuba_scene.ray_intersect(mi.Ray3f(origin, direction), mi.RayFlags.All, coherent=False, active=exists)
    active = si.is_valid()
    active &= is_in(stage.specular, si.bsdf(), active)
    branches = []
    for lobe in stage.delta_lobes:
        context = mi.BSDFContext()
        context.component = lobe
        sample, weight = si.bsdf().sample(context, si, 0.5, mi.Point2f(0.5), active)
        weight = throughput * weight
        follows = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta) & dr.any(weight > 0)
        onward = si.spawn_ray(si.to_world(sample.wo))
        branches.append((follows, [*onward.o, *onward.d, *weight]))
    return throughput * stage.lights.at(si).eval(si), branches


def specular_light(
    stage: Stage, ray: mi.Ray3f, max_events: int, shines: NDArray[np.bool_] | None = None
) -> NDArray[np.float32]:
    """Radiance (N, 3) of lights and sky along `ray`, directly visible and after up to `max_events` specular events.

    shines: (N,), the rays to follow; by default all. It is 0 for the others.
    """
    count = dr.width(ray.d)
    values = [np.broadcast_to(np.array(value), count) for value in (*ray.o, *ray.d, *mi.Color3f(1))]
    pixel = np.arange(count) if shines is None else np.flatnonzero(shines)
    rays = np.stack(values, axis=-1)[pixel]  # (N, 9): origin and direction of a chain's last ray, and its throughput
    total = np.zeros((count, 3))
    for _ in range(max_events + 1):
        if len(pixel):
            batch = np.pad(rays, ((0, max(0, MIN_BATCH - len(rays))), (0, 0)))  # rays without throughput end at once
            radiance, branches = stage.replay(branches_at_end, *map(upload, batch.T))
            # In the order of chains; Dr.Jit would add in any order.
            np.add.at(total, pixel, columns(radiance)[: len(rays)])
            # Chains branch: a pixel that shows glass has several, and many have none.
            longer = [(np.array(follows)[: len(rays)], columns(onward)[: len(rays)]) for follows, onward in branches]
            rays = np.concatenate([rays[:0], *(onward[follows] for follows, onward in longer)])
            pixel = np.concatenate([pixel[:0], *(pixel[follows] for follows, _ in longer)])
    return total.astype(np.float32)
