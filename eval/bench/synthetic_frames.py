"""A moving sequence made without a renderer, for measuring speed: shapes, motion and noise as those of real frames."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from datasets.frame import Cameras, Frame, to_tensor
from scenes.camera import View, directions, intrinsics, look_at, motion_vectors, pixel_centres

Array = NDArray[np.float64]

PLANES = (
    ((0, 1, 0), -1.5),
    ((0, 0, 1), -6.0),
    ((1, 0, 0), -4.0),
)  # floor, back and side wall: n, d; n · p = d
TOP = 1.7  # height of the walls; sky above
SPHERES = 10
LIGHT = np.array([0.5, 0.8, 0.33])  # direction to it
HIT_DIRECT, HIT_INDIRECT = 0.5, 0.2  # share of pixels whose one sample finds any light
SEED = 0


class Surfaces(NamedTuple):
    """What rays meet first: depth (...,) along the viewing axis, 0 for sky; mesh id (...,); world normal (..., 3)."""

    depth: Array
    mesh_id: NDArray[np.int64]
    normal: Array


def spheres(index: int) -> tuple[Array, Array]:
    """Centres (N, 3) and radii (N,) in frame `index`: every other sphere circles, so that it covers and uncovers."""
    rng = np.random.default_rng(SEED)
    centres = rng.uniform((-3.5, -1.2, -5.5), (3.5, 1.5, -1.0), (SPHERES, 3))
    angle = 0.08 * index + rng.uniform(0, 2 * np.pi, SPHERES)
    centres[::2, :2] += 0.6 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[::2]
    return centres, rng.uniform(0.25, 0.7, SPHERES)


def view(index: int, height: int, width: int) -> View:
    """The camera slides and turns; planes stand still, spheres rest at the origin and are moved to their centres."""
    eye = np.array([0.02 * index - 0.5, 0.3, 3.0])
    poses = np.tile(np.eye(4), (len(PLANES) + SPHERES, 1, 1))
    poses[len(PLANES) :, :3, 3] = spheres(index)[0]
    return View(intrinsics(70.0, height, width), look_at(eye, np.array([0.01 * index, 0.0, -3.0])), poses)


def cast(pixels: Array, index: int, view: View) -> Surfaces:
    """Surfaces at `pixels` (..., 2) of frame `index`. Rays have unit length along the viewing axis: t is the depth."""
    ray, eye = directions(pixels, view), view.camera_to_world[:3, 3]
    depth, mesh_id, normal = np.full(ray.shape[:-1], np.inf), np.zeros(ray.shape[:-1], np.int64), np.zeros_like(ray)

    def meet(mesh: int, t: Array, n: Array) -> None:
        nearer = (t > 0) & (t < depth)
        depth[nearer], mesh_id[nearer], normal[nearer] = t[nearer], mesh, np.broadcast_to(n, ray.shape)[nearer]

    with np.errstate(divide="ignore", invalid="ignore"):  # rays along a plane, or past a sphere: inf or NaN, no hit
        for mesh, (n, offset) in enumerate(PLANES, 1):
            t = (offset - eye @ n) / (ray @ np.array(n, float))
            meet(mesh, np.where(eye[1] + t * ray[..., 1] < TOP, t, np.inf), np.array(n, float))
        for mesh, (centre, radius) in enumerate(zip(*spheres(index), strict=True), 1 + len(PLANES)):
            a, b = (ray**2).sum(axis=-1), ray @ (eye - centre)
            t = (-b - np.sqrt(b**2 - a * ((eye - centre) @ (eye - centre) - radius**2))) / a
            meet(mesh, t, (eye + t[..., None] * ray - centre) / radius)
    return Surfaces(np.where(mesh_id > 0, depth, 0), mesh_id, normal)


def dual_motion(pixels: Array, index: int, seen: Surfaces, motion: Array, now: View, before: View) -> Array:
    """NTD §3.2: where another surface stood at y in the previous frame, it leads back: x_prev = y + x - z."""
    height, width = pixels.shape[:2]
    y = pixels + motion
    covering = cast(y, index - 1, before)
    # y + x - z - x, with z - y the forward vector of what was seen at y.
    dual = -motion_vectors(y, covering.depth, covering.mesh_id, before, now)
    inside = ((np.stack([y, pixels + dual]) >= 0) & (np.stack([y, pixels + dual]) <= (width, height))).all(axis=(0, -1))
    return np.where((inside & (covering.mesh_id != seen.mesh_id))[..., None], dual, motion)


def noisy(rng: np.random.Generator, mean: Array, share: float) -> Array:
    """One sample a pixel of light `mean` (H, W, 3): black but in a `share` of pixels; few are fireflies."""
    size = (*mean.shape[:2], 1)
    heavy_tailed = rng.lognormal(-0.5, 1.0, size)  # of mean 1
    return mean * np.where(rng.random(size) < share, heavy_tailed / share, 0)


def synthetic_frame(index: int, height: int, width: int) -> Frame:
    """Frame `index` of an endless sequence, with all channels but references. The same bytes whenever it is made."""
    pixels = pixel_centres(height, width)
    now, before = view(index, height, width), view(max(index - 1, 0), height, width)
    seen = cast(pixels, index, now)
    motion = motion_vectors(pixels, seen.depth, seen.mesh_id, now, before)
    dual = dual_motion(pixels, index, seen, motion, now, before) if index else motion

    point = now.camera_to_world[:3, 3] + seen.depth[..., None] * directions(pixels, now)
    centred = point - np.concatenate([np.zeros((1, 3)), now.object_to_world[:, :3, 3]])[seen.mesh_id]
    checker = np.floor(3 * centred + 1e-6).sum(axis=-1) % 2
    rng = np.random.default_rng(SEED)
    colour = rng.uniform(0.2, 0.9, (1 + len(now.object_to_world), 3))[seen.mesh_id]
    hit = (seen.mesh_id > 0)[..., None]
    albedo = np.where(hit, colour * (0.6 + 0.4 * checker[..., None]), 1)
    lit = np.where(hit, albedo * (seen.normal @ LIGHT).clip(0)[..., None], 0)
    rng = np.random.default_rng((SEED, index))
    channels = {
        "direct": noisy(rng, 2 * lit, HIT_DIRECT),
        "indirect": noisy(rng, np.where(hit, 0.3 * albedo, 0), HIT_INDIRECT),
        "emission": np.where(hit, 0, [0.4, 0.6, 1.0]),
        "albedo": albedo,
        "normal": seen.normal,
        "depth": seen.depth[..., None],
        "roughness": np.where(seen.mesh_id % 3 == 2, 0.2, 1.0)[..., None],
        "mesh_id": seen.mesh_id[..., None],
        "motion": motion,
        "dual_motion": dual,
    }
    gain = to_tensor(np.ones((1, 1, 3)))
    tensors = {name: to_tensor(array) for name, array in channels.items()}
    return Frame(tensors, Cameras.of(now), Cameras.of(before), gain, "synthetic sequence")
