"""Camera flights through the free space of a room."""

import numpy as np
from numpy.typing import NDArray

from scenes.animation import Camera, Track
from scenes.boxes import first_hit, overlaps
from scenes.camera import Array, intrinsics, look_at
from scenes.draws import log_uniform
from scenes.layout import Layout

EYE_CLEARANCE = 0.3  # m, between the camera and reserved boxes
MAX_SPEED = 20 / 256  # of things in the image, in image widths per frame
PATH_ATTEMPTS = 200
TARGET_CANDIDATES = 200


def flight_path(layout: Layout) -> Track:
    """A smooth path (3,) of the camera at a random speed; in some clips it ends early. Its surroundings are reserved.

    To be called before the room is full. Raises RuntimeError if no path is free.
    """
    rng = layout.rng
    x, z = layout.size[[0, 2]] / 2 - 0.4
    low = np.array([-x, 0.35, -z])
    high = np.array([x, min(layout.size[1] - 0.3, 2.0), z])
    stop = layout.last_frame * rng.uniform(0.3, 0.7) if rng.random() < 0.15 else layout.last_frame
    for attempt in range(PATH_ATTEMPTS):
        reach = log_uniform(rng, 0.003, 0.06) * layout.frames * (1 - attempt / PATH_ATTEMPTS)
        start = rng.uniform(low, high)
        heading = rng.uniform(-np.pi, np.pi) + np.cumsum(rng.normal(0, 0.5, 3))
        steps = np.stack([np.cos(heading), rng.normal(0, 0.25, 3), np.sin(heading)], axis=1) * reach / 3
        track = Track(start + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]), 0, stop)
        points = np.stack([track.at(frame) for frame in range(layout.frames)])
        around = np.stack([points - EYE_CLEARANCE, points + EYE_CLEARANCE], axis=1)
        if (points > low).all() and (points < high).all() and not overlaps(around, layout.boxes):
            layout.reserve(*around[:: max(1, layout.frames // 16)], around[-1])
            return track
    raise RuntimeError("no free path for the camera")


def image_points(points: Array, eye: Array, targets: Array, x_fov: float) -> tuple[Array, NDArray[np.bool_]]:
    """Positions (T, N, 2) of `points` (N, 3) in widths of a square image, and whether they (T, N) lie in it.

    Of T cameras at `eye` (3,), which look at `targets` (T, 3).
    """
    in_camera = (points - eye) @ look_at(eye, targets)[..., :3, :3]
    ahead = in_camera[..., 2] > 0.2
    pixels = (in_camera @ intrinsics(x_fov, 1, 1).T)[..., :2] / np.where(ahead, in_camera[..., 2], 1)[..., None]
    return pixels, ahead & ((pixels > 0) & (pixels < 1)).all(axis=-1)


def aim_camera(layout: Layout, eye: Track, obstacles: Array) -> Camera:
    """A camera on the path `eye` that pans from one thing towards another.

    The best of many candidates: most things visible, moving at about a random speed, and none of the `obstacles`
    (M, 2, 3) close to the lens.
    """
    rng, frames = layout.rng, layout.frames
    moments = sorted({0, frames // 4, frames // 2, 3 * frames // 4, frames - 1})
    things = np.stack(layout.centres)
    in_sight = [first_hit(eye.at(moment), things, layout.boxes[: layout.walls]) > 1 for moment in moments]
    candidates = things[in_sight[0]] if in_sight[0].any() else things
    x_fov = float(rng.uniform(50, 80))
    wanted_speed = log_uniform(rng, MAX_SPEED / 40, MAX_SPEED)

    def draw() -> Array:
        a, b = candidates[rng.integers(len(candidates), size=2)]
        return np.stack([a, a + (b - a) * rng.uniform()]) + rng.normal(0, 0.15, (2, 3))

    def scores(targets: Track) -> Array:
        """Of each of the T candidates, which `targets` has side by side (T, 3)."""
        count = np.full(TARGET_CANDIDATES, 8)  # of visible things
        speed, steepness = np.zeros((2, TARGET_CANDIDATES))
        nearest = np.full(TARGET_CANDIDATES, np.inf)
        sight = np.ones(TARGET_CANDIDATES)  # m, free in front of the lens
        for moment, unhidden in zip(moments, in_sight, strict=True):
            here, there = eye.at(moment), targets.at(moment)
            distance = np.linalg.norm(there - here, axis=1)
            now, visible = image_points(things, here, there, x_fov)
            then, _ = image_points(things, eye.at(moment + 1), targets.at(moment + 1), x_fov)
            moved = np.where(visible[..., None], np.abs(now - then), 0).max(axis=(1, 2))
            count = np.minimum(count, (visible & unhidden).sum(axis=1))
            speed = np.maximum(speed, moved)
            sight = np.minimum(sight, first_hit(here, there, obstacles) * distance)
            steepness = np.maximum(steepness, np.abs(there - here)[:, 1] / distance)
            nearest = np.minimum(nearest, distance)
        faults = np.sum([speed > MAX_SPEED, nearest < 0.7, steepness > 0.7], axis=0)
        slowness = np.abs(np.log(np.maximum(speed, 1e-4) / wanted_speed))
        return np.asarray(count + 4 * np.minimum(sight, 0.7) - slowness - 50 * faults)

    drawn = np.stack([draw() for _ in range(TARGET_CANDIDATES)], axis=1)
    best = scores(Track(drawn, eye.first, eye.last)).argmax()
    return Camera(eye, Track(drawn[:, best], eye.first, eye.last), Track.constant(x_fov))
