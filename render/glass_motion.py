"""Motion of what smooth glass shows: the same branch, traced from the camera of the previous frame."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from render.loading import columns
from render.look_through import look_through
from render.stage import Stage
from scenes.camera import FAR_OUTSIDE, Array, View, move

NEWTON_STEPS = 6
PROBE = 0.25  # px between the rays from which derivatives are estimated
MAX_STEP = 8.0  # px
EXACT, FOUND_WITHIN = 0.02, 0.5  # px


class TracedChains(NamedTuple):
    """The chains of specular events through `pixels` (N, 2), by the rarer branch at the first glass or the other."""

    pixels: Array
    rarer_first: bool
    ends: Array  # (N, 3), world
    mesh_id: NDArray[np.integer]  # (N,), at the end
    through_glass: NDArray[np.bool_]  # (N,)


def chains_at(stage: Stage, view: View, pixels: Array, rarer_first: bool) -> TracedChains:
    """The chains through `pixels` (N, 2), for a stage posed for `view`'s frame."""
    shown = look_through(stage, view, stage.rays(view, pixels), rarer_first)
    ends = columns(shown.point).astype(np.float64) * stage.unit
    mesh_id = np.array(shown.channels["mesh_id"])
    return TracedChains(pixels, rarer_first, ends, mesh_id, np.array(shown.through_glass))


def newton_step(
    stage: Stage, view: View, place: Array, rarer_first: bool, target: Array, mesh_id: NDArray[np.integer]
) -> tuple[Array, Array]:
    """From pixels `place` (N, 2) towards those whose chains end at `target` (N, 3), on the meshes `mesh_id` (N,).

    (the step (N, 2) in px, about how many pixels `place` is off (N,): infinite on another mesh).
    """
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
    return step.clip(-MAX_STEP, MAX_STEP), np.where(same, pixels_off, np.inf)


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
