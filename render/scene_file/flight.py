"""Smooth camera flights through the free space of any scene, which ray casts determine."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from render.backend import dr, mi
from render.loading import corners, upload
from render.stage import Stage
from scenes.animation import Camera, Track
from scenes.camera import Array, View, cross, directions, intrinsics, look_at, pixel_centres, unit
from scenes.draws import Rng, log_uniform

MIN_STEP, MAX_STEP = 0.002, 0.02  # of the distance to the target, per frame
CLEARANCE_SHARE = 0.3  # kept along a flight, of the free space around the file's camera
MAX_CLEARANCE = 0.1  # of the distance to the target
MAX_PATHS = 100  # random paths, shorter and shorter
MAX_HOPS = 4  # to the start of a flight
TARGET_SHIFT = 0.1  # standard deviation of the target's motion along an axis, of the distance to it
VIEW_ATTEMPTS = 24  # random directions for the view of a place
VIEW_GRID = (9, 16)  # rows and columns of rays that sample a view
STEEPEST = 0.25  # cosine of the steepest pitch at which an image tells which world axis is up
PROBE_RAYS = 128  # that measure the free space around a point


def sphere(count: int) -> Array:
    """Evenly spread directions (count, 3): a Fibonacci lattice."""
    y = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - y**2)
    return np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], axis=1)


class Space:
    """The free space of a stage in its current pose."""

    def __init__(self, stage: Stage):
        self.stage = stage
        self.low, self.high = corners(stage.mitsuba_scene.bbox()) * stage.unit
        self.size = float(np.linalg.norm(self.high - self.low)) or 1.0  # of a single point

    def distances(self, origins: Array, towards: Array) -> Array:
        """Distances (N,) from `origins` (N, 3) along the directions `towards` (N, 3); infinite without a hit."""
        unit = self.stage.unit
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        origin = mi.Point3f(*(upload(column) for column in (origins / unit).T))
        ray = mi.Ray3f(origin, mi.Vector3f(*(upload(column) for column in towards.T)))
        si = self.stage.mitsuba_scene.ray_intersect_preliminary(ray, coherent=False)
        distance = dr.select(si.is_valid(), si.t, np.inf)
        return np.array(distance, np.float64) * unit

    def nearest(self, points: Array) -> Array:
        """Distances (N,) from `points` (N, 3) to the nearest surface, by PROBE_RAYS rays."""
        towards = np.tile(sphere(PROBE_RAYS), (len(points), 1))
        distances = self.distances(np.repeat(points, PROBE_RAYS, axis=0), towards)
        return distances.reshape(len(points), PROBE_RAYS).min(axis=1)

    def is_free(self, points: Array, clearance: float) -> bool:
        """Whether the path along `points` (N, 3) keeps a `clearance` to all surfaces."""
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        moving = lengths > 0
        if moving.any() and (self.distances(points[:-1][moving], steps[moving]) < lengths[moving] + clearance).any():
            return False
        return bool((self.nearest(points) >= clearance).all())

    def view_distances(self, eye: Array, target: Array, camera: Camera) -> Array:
        """Distances (N,) of a grid of pixels from `eye` towards `target`, with the field of view of `camera`."""
        K = intrinsics(float(camera.x_fov.at(0)), *VIEW_GRID)
        view = View(K, look_at(eye, target, camera.up.at(0)), np.zeros((0, 4, 4)))
        towards = directions(pixel_centres(*VIEW_GRID).reshape(-1, 2), view)
        return self.distances(np.tile(eye, (len(towards), 1)), towards)


class Start(NamedTuple):
    eye: Array  # (3,)
    forward: Array  # (3,), of unit length
    distance: float  # of visible surfaces
    clearance: float


def upright(camera: Camera) -> Camera:
    """The same view with a world axis as up, unless the camera is rolled about its viewing axis.

    Of axes that fit it is y or z, if one of these can be: the image's own up is far from the world's in steep views.
    """
    eye, target, up = camera.eye.at(0), camera.target.at(0), camera.up.at(0)
    left = unit(cross(up, target - eye))
    fit = np.where(np.abs(left) <= 1e-3, unit(up), 0)
    best = 1 + fit[1:].argmax() if fit[1:].max() > STEEPEST else np.abs(fit).argmax()
    if abs(fit[best]) <= STEEPEST:
        return camera
    axis = np.zeros(3)
    axis[best] = np.sign(fit[best])
    return replace(camera, up=Track.constant(axis))


def typical_distance(distances: Array, size: float) -> float:
    """The median distance of hits; a quarter of the scene's `size` without any."""
    hits = distances[np.isfinite(distances)]
    return float(np.median(hits)) if len(hits) else size / 4


def start_at(space: Space, camera: Camera) -> Start:
    eye = camera.eye.at(0)
    forward = camera.target.at(0) - eye
    forward /= np.linalg.norm(forward)
    distance = typical_distance(space.view_distances(eye, eye + forward, camera), space.size)
    near = min(float(space.nearest(eye[None])[0]), distance)
    return Start(eye, forward, distance, min(CLEARANCE_SHARE * near, MAX_CLEARANCE * distance))


def random_direction(rng: Rng, up: Array, tilt: float) -> Array:
    """A random direction (3,) whose elevation above the horizon has a standard deviation of `tilt` radians."""
    across = cross(up, rng.normal(size=3))
    across /= np.linalg.norm(across)
    angle = np.clip(rng.normal(0, tilt), -1, 1)
    return np.cos(angle) * across + np.sin(angle) * up / np.linalg.norm(up)


def start_elsewhere(space: Space, camera: Camera, start: Start, rng: Rng) -> Start:
    """A flight's start a few free hops away, with something in view."""
    up = camera.up.at(0)
    eye = start.eye
    for _ in range(rng.integers(1, MAX_HOPS + 1)):
        heading = random_direction(rng, up, 0.3)
        free = min(float(space.distances(eye[None], heading[None])[0]), 2 * start.distance)
        there = eye + heading * free * rng.uniform(0.2, 0.7)
        if space.is_free(np.stack([eye, there]), start.clearance):
            eye = there
    wanted = np.isfinite(space.view_distances(start.eye, start.eye + start.forward, camera)).mean() / 2

    def quality(forward: Array) -> tuple[bool, float]:
        """Whether enough is visible, and not too near; and how similar its distance is to that of the file's view."""
        distances = space.view_distances(eye, eye + forward, camera)
        distance = typical_distance(distances, space.size)
        enough = bool(np.isfinite(distances).mean() >= wanted)
        far = enough and bool(np.quantile(distances, 0.1, method="lower") > 2 * start.clearance)
        return far, -abs(float(np.log(distance / start.distance)))

    forward = max((random_direction(rng, up, 0.25) for _ in range(VIEW_ATTEMPTS)), key=quality)
    distance = typical_distance(space.view_distances(eye, eye + forward, camera), space.size)
    return Start(eye, forward, distance, start.clearance)


def path(space: Space, camera: Camera, start: Start, frames: int, rng: Rng) -> Track:
    """A smooth free path (3,) from `start`; constant if no attempt is free."""
    up = camera.up.at(0)
    moments = np.linspace(0, frames - 1, min(frames, 17))
    for attempt in range(MAX_PATHS):
        reach = start.distance * log_uniform(rng, MIN_STEP, MAX_STEP) * frames * (1 - attempt / MAX_PATHS)
        heading = random_direction(rng, up, 0.3)
        steps = np.array([heading + 0.5 * random_direction(rng, up, 0.3) for _ in range(3)])
        steps *= reach / np.linalg.norm(steps, axis=1, keepdims=True) / 3
        track = Track(start.eye + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)]), 0, max(frames - 1, 1))
        if space.is_free(np.stack([track.at(moment) for moment in moments]), start.clearance):
            return track
    return Track.constant(start.eye)


def aim(space: Space, camera: Camera, start: Start, eye: Track, frames: int, rng: Rng) -> Track:
    """The camera's target (3,): at first `forward`, in the end a nearby point at about the same distance."""
    begin = start.eye + start.forward * start.distance
    last = eye.at(frames - 1)
    for attempt in range(VIEW_ATTEMPTS):
        aside = TARGET_SHIFT * start.distance * (1 - attempt / VIEW_ATTEMPTS) * rng.normal(size=3)
        if typical_distance(space.view_distances(last, begin + aside, camera), space.size) > start.distance / 2:
            return Track(np.stack([begin, begin + aside]), 0, max(frames - 1, 1))
    return Track.constant(begin)


def fly(stage: Stage, camera: Camera, frames: int, seed: int, from_here: bool) -> Camera:
    """A flight through the free space of a stage, deterministic in the arguments.

    It begins with the view of `camera`, or unless `from_here` at another place that can be reached from it.
    """
    rng = np.random.default_rng(seed)
    space = Space(stage)
    camera = upright(camera)
    start = start_at(space, camera)
    if not from_here:
        start = start_elsewhere(space, camera, start, rng)
    eye = path(space, camera, start, frames, rng)
    return replace(camera, eye=eye, target=aim(space, camera, start, eye, frames, rng))
