"""Smooth camera flights through the free space of any scene, found by casting rays."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from render.backend import dr, mi
from render.loading import upload
from render.stage import Stage
from scenes.animation import Camera, Track
from scenes.camera import Array, View, directions, intrinsics, look_at, pixel_centres
from scenes.draws import Rng, log_uniform

SLOWEST, FASTEST = 0.002, 0.02  # of the way to what is looked at, in a frame
CLEARANCE = 0.3  # of the free space around the file's camera, and
MOST_CLEARANCE = 0.1  # of the way to what is looked at, at most: kept free along a flight
PATHS = 100  # drawn, ever shorter ones, until one is free
HOPS = 4  # to where flights begin, at most
TURN = 0.1  # standard deviation of how far what is looked at moves along an axis, of the way to it
LOOKS = 24  # directions drawn for the view of a place
VIEW_GRID = (9, 16)  # rows and columns of pixels that look what a view shows
AROUND = 128  # rays that feel for what is near


def sphere(count: int) -> Array:
    """Directions (count, 3), spread evenly: a Fibonacci lattice."""
    y = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    radius = np.sqrt(1 - y**2)
    return np.stack([radius * np.cos(angle), y, radius * np.sin(angle)], axis=1)


class Space:
    """Where the camera may be: distances to what is around, on a stage as it stands in the first frame."""

    def __init__(self, stage: Stage):
        self.stage = stage
        box = stage.mitsuba_scene.bbox()
        self.low = np.array(box.min, np.float64).ravel() * stage.unit
        self.high = np.array(box.max, np.float64).ravel() * stage.unit
        self.size = float(np.linalg.norm(self.high - self.low)) or 1.0  # of a single point

    def distances(self, origins: Array, towards: Array) -> Array:
        """How far (N,) it is from `origins` (N, 3) along the directions `towards` (N, 3); infinite where nothing is."""
        unit = self.stage.unit
        towards = towards / np.linalg.norm(towards, axis=1, keepdims=True)
        origin = mi.Point3f(*(upload(column) for column in (origins / unit).T))
        ray = mi.Ray3f(origin, mi.Vector3f(*(upload(column) for column in towards.T)))
        si = self.stage.mitsuba_scene.ray_intersect_preliminary(ray, coherent=False)
        distance = dr.select(si.is_valid(), si.t, np.inf)
        return np.array(distance, np.float64) * unit

    def nearest(self, points: Array) -> Array:
        """How near (N,) anything is to `points` (N, 3), as AROUND rays feel it."""
        towards = sphere(AROUND)
        origins = np.repeat(points, AROUND, axis=0)
        return self.distances(origins, np.tile(towards, (len(points), 1))).reshape(len(points), AROUND).min(axis=1)

    def is_free(self, points: Array, clearance: float) -> bool:
        """Whether the way along `points` (N, 3) leads through nothing, and nothing is as near as `clearance`."""
        steps = np.diff(points, axis=0)
        lengths = np.linalg.norm(steps, axis=1)
        moving = lengths > 0
        if moving.any() and (self.distances(points[:-1][moving], steps[moving]) < lengths[moving] + clearance).any():
            return False
        return bool((self.nearest(points) >= clearance).all())

    def seen(self, eye: Array, target: Array, camera: Camera) -> Array:
        """Distances (N,) that a grid of pixels sees from `eye` towards `target`, by the lens of `camera`."""
        K = intrinsics(float(camera.x_fov.at(0)), *VIEW_GRID)
        view = View(K, look_at(eye, target, camera.up.at(0)), np.zeros((0, 4, 4)))
        towards = directions(pixel_centres(*VIEW_GRID).reshape(-1, 2), view)
        return self.distances(np.tile(eye, (len(towards), 1)), towards)


class Place(NamedTuple):
    """Where a flight begins, and how far what it looks at is away."""

    eye: Array  # (3,)
    forward: Array  # (3,), of unit length
    distance: float
    clearance: float


def upright(camera: Camera) -> Camera:
    """The same view with an axis of the world upwards, where the camera is not rolled about its viewing axis."""
    eye, target, up = camera.eye.at(0), camera.target.at(0), camera.up.at(0)
    axis = np.zeros(3)
    axis[np.abs(up).argmax()] = np.sign(up[np.abs(up).argmax()])
    left = np.cross(up, target - eye)
    rolled = abs(float(left @ axis)) > 1e-3 * np.linalg.norm(left)
    return camera if rolled else replace(camera, up=Track.constant(axis))


def distance_of(seen: Array, size: float) -> float:
    """How far away what is seen mostly is; a quarter of the scene's `size` where nothing is."""
    hits = seen[np.isfinite(seen)]
    return float(np.median(hits)) if len(hits) else size / 4


def place_of(space: Space, camera: Camera) -> Place:
    """Where a camera at rest is."""
    eye = camera.eye.at(0)
    forward = camera.target.at(0) - eye
    forward /= np.linalg.norm(forward)
    distance = distance_of(space.seen(eye, eye + forward, camera), space.size)
    near = min(float(space.nearest(eye[None])[0]), distance)
    return Place(eye, forward, distance, min(CLEARANCE * near, MOST_CLEARANCE * distance))


def turned(rng: Rng, up: Array, tilt: float) -> Array:
    """A random direction (3,) whose angle to the plane across `up` has a standard deviation of `tilt` radians."""
    across = np.cross(up, rng.normal(size=3))
    across /= np.linalg.norm(across)
    angle = np.clip(rng.normal(0, tilt), -1, 1)
    return np.cos(angle) * across + np.sin(angle) * up / np.linalg.norm(up)


def elsewhere(space: Space, camera: Camera, start: Place, rng: Rng) -> Place:
    """Another place, a few free hops away from `start`, with something to look at."""
    up = camera.up.at(0)
    eye = start.eye
    for _ in range(rng.integers(1, HOPS + 1)):
        heading = turned(rng, up, 0.3)
        free = min(float(space.distances(eye[None], heading[None])[0]), 2 * start.distance)
        there = eye + heading * free * rng.uniform(0.2, 0.7)
        if space.is_free(np.stack([eye, there]), start.clearance):
            eye = there
    wanted = np.isfinite(space.seen(start.eye, start.eye + start.forward, camera)).mean() / 2

    def quality(forward: Array) -> tuple[bool, float]:
        """Whether enough is seen, and not too near; and how near its distance is to that of the file's view."""
        seen = space.seen(eye, eye + forward, camera)
        distance = distance_of(seen, space.size)
        enough = np.isfinite(seen).mean() >= wanted and np.quantile(seen, 0.1, method="lower") > 2 * start.clearance
        return bool(enough), -abs(float(np.log(distance / start.distance)))

    forward = max((turned(rng, up, 0.25) for _ in range(LOOKS)), key=quality)
    return Place(eye, forward, distance_of(space.seen(eye, eye + forward, camera), space.size), start.clearance)


def path(space: Space, camera: Camera, start: Place, frames: int, rng: Rng) -> Track:
    """A smooth free way of the eye (3,) that begins at `start`; at rest there where none of PATHS is free."""
    up = camera.up.at(0)
    moments = np.linspace(0, frames - 1, min(frames, 17))
    for attempt in range(PATHS):
        reach = start.distance * log_uniform(rng, SLOWEST, FASTEST) * frames * (1 - attempt / PATHS)
        heading = turned(rng, up, 0.3)
        steps = np.array([heading + 0.5 * turned(rng, up, 0.3) for _ in range(3)])
        steps *= reach / np.linalg.norm(steps, axis=1, keepdims=True) / 3
        keys = start.eye + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        track = Track(keys, 0, max(frames - 1, 1))
        if space.is_free(np.stack([track.at(moment) for moment in moments]), start.clearance):
            return track
    return Track.constant(start.eye)


def aim(space: Space, camera: Camera, start: Place, eye: Track, frames: int, rng: Rng) -> Track:
    """What the camera looks at (3,): at first `forward`, in the end something near it that is as far away."""
    begin = start.eye + start.forward * start.distance
    last = eye.at(frames - 1)
    for attempt in range(LOOKS):
        aside = TURN * start.distance * (1 - attempt / LOOKS) * rng.normal(size=3)
        if distance_of(space.seen(last, begin + aside, camera), space.size) > start.distance / 2:
            return Track(np.stack([begin, begin + aside]), 0, max(frames - 1, 1))
    return Track.constant(begin)


def fly(stage: Stage, camera: Camera, frames: int, seed: int, from_here: bool) -> Camera:
    """A flight of so many frames through the free space of a stage: a function of the arguments alone.

    It begins with the view of `camera`, or elsewhere, where that can be reached from.
    """
    rng = np.random.default_rng(seed)
    space = Space(stage)
    camera = upright(camera)
    start = place_of(space, camera)
    if not from_here:
        start = elsewhere(space, camera, start, rng)
    eye = path(space, camera, start, frames, rng)
    return replace(camera, eye=eye, target=aim(space, camera, start, eye, frames, rng))
