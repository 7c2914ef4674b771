"""Camera flights through free space that look at things."""

import numpy as np
from numpy.typing import NDArray

from scenes.animation import Array, Camera, Track
from scenes.camera import intrinsics, look_at
from scenes.finish import log_uniform
from scenes.layout import Layout

CLEARANCE = 0.3  # m, between the camera and what anything occupies
FASTEST = 20 / 256  # widths of the image that things move in a frame, at most
TRIES = 200


def clear(points: Array, boxes: Array, clearance: float) -> bool:
    """Whether all `points` (N, 3) keep `clearance` from all `boxes` (M, 2, 3), along each axis."""
    inside = (points[:, None] > boxes[:, 0] - clearance) & (points[:, None] < boxes[:, 1] + clearance)
    return not bool(inside.all(axis=2).any())


def path(layout: Layout) -> Track:
    """A smooth way (3,) of the eye, of its own speed, in some clips ending early; its surroundings are reserved.

    Call it before the room is full: what comes later keeps out of its way.
    """
    rng, last = layout.rng, max(layout.frames - 1, 1)
    x, z = layout.size[[0, 2]] / 2 - 0.4
    low, high = np.array([-x, 0.35, -z]), np.array([x, min(layout.size[1] - 0.3, 2.0), z])
    stop = last * rng.uniform(0.3, 0.7) if rng.random() < 0.15 else last
    for attempt in range(TRIES):
        reach = log_uniform(rng, 0.003, 0.06) * layout.frames * (1 - attempt / TRIES)
        start, heading = rng.uniform(low, high), rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(0, 0.5, 3))
        steps = np.stack([np.cos(heading), rng.normal(0, 0.25, 3), np.sin(heading)], axis=1) * reach / 3
        keys = start + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        track = Track(keys, 0, stop)
        points = np.stack([track.at(frame) for frame in range(layout.frames)])
        if (points > low).all() and (points < high).all() and clear(points, layout.boxes, CLEARANCE):
            layout.reserve(*(np.stack([p - CLEARANCE, p + CLEARANCE]) for p in points[:: max(1, layout.frames // 16)]))
            layout.reserve(np.stack([points[-1] - CLEARANCE, points[-1] + CLEARANCE]))
            return track
    raise RuntimeError("no free way for the camera")


def image_points(points: Array, eye: Array, target: Array, x_fov: float) -> tuple[Array, NDArray[np.bool_]]:
    """Positions (N, 2) of `points` (N, 3) in widths of a square image, and which (N,) lie in it."""
    matrix, K = look_at(eye, target), intrinsics(x_fov, 1, 1)
    in_camera = (points - eye) @ matrix[:3, :3]
    ahead = in_camera[:, 2] > 0.2
    pixels = (in_camera @ K.T)[:, :2] / np.where(ahead, in_camera[:, 2], 1)[:, None]
    return pixels, ahead & ((pixels > 0) & (pixels < 1)).all(axis=1)


def first_hit(eye: Array, towards: Array, boxes: Array) -> Array:
    """At which share of the ways from `eye` to `towards` (N, 3) the first of `boxes` (M, 2, 3) begins; inf if none."""
    ways = (towards - eye)[:, None, None]
    ways = np.where(np.abs(ways) < 1e-9, 1e-9, ways)
    near, far = np.sort((boxes[None] - eye) / ways, axis=2).transpose(2, 0, 1, 3)
    enter, leave = near.max(axis=-1), far.min(axis=-1)
    met = (enter < leave) & (leave > 0)
    return np.asarray(np.where(met, enter, np.inf).min(axis=1, initial=np.inf))


def look(layout: Layout, eye: Track, obstacles: Array) -> Camera:
    """A camera on the way `eye` that looks from one thing toward another, at a speed drawn evenly on a log scale.

    Of many tries the one that keeps most things in view, with nothing right before the lens.
    """
    rng, frames = layout.rng, layout.frames
    moments = sorted({0, frames // 4, frames // 2, 3 * frames // 4, frames - 1})
    things, walls = np.stack(layout.centres), layout.boxes[: layout.walls]
    in_sight = [first_hit(eye.at(moment), things, walls) > 1 for moment in moments]
    candidates = things[in_sight[0]] if in_sight[0].any() else things
    x_fov, wanted = float(rng.uniform(50, 80)), log_uniform(rng, FASTEST / 40, FASTEST)

    def score(target: Track) -> float:
        seen, speed, sight, steep, away = [], 0.0, 1.0, 0.0, np.inf
        for moment, unhidden in zip(moments, in_sight, strict=True):
            here, there = eye.at(moment), target.at(moment)
            distance = float(np.linalg.norm(there - here))
            now, visible = image_points(things, here, there, x_fov)
            then, _ = image_points(things, eye.at(moment + 1), target.at(moment + 1), x_fov)
            seen.append((visible & unhidden).sum())
            speed = max(speed, float(np.abs(now - then)[visible].max(initial=0)))
            sight = min(sight, float(first_hit(here, there[None], obstacles)[0]) * distance)
            steep, away = max(steep, abs(there[1] - here[1]) / distance), min(away, distance)
        bad = (speed > FASTEST) + (away < 0.7) + (steep > 0.7)
        return min(*seen, 8) + 4 * min(sight, 0.7) - abs(np.log(max(speed, 1e-4) / wanted)) - 50.0 * bad

    def draw() -> Track:
        a, b = candidates[rng.integers(len(candidates), size=2)]
        keys = np.stack([a, a + (b - a) * rng.uniform()]) + rng.normal(0, 0.15, (2, 3))
        return Track(keys, eye.first, eye.last)

    return Camera(eye, max((draw() for _ in range(TRIES)), key=score), Track.constant(x_fov))
