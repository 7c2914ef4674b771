"""A procedural moving sequence for measuring speed, with shapes, motion and noise similar to rendered frames."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from datasets.cameras import Cameras
from datasets.channels import CHANNELS, SAMPLE_BUFFERS
from datasets.frame import Frame, to_tensor
from scenes.camera import Array, View, directions, intrinsics, look_at, motion_vectors, pixel_centres

# Normal n and offset d, n · p = d, of the ground, the back wall and the side wall.
PLANES = (((0, 1, 0), -1.5), ((0, 0, 1), -6.0), ((1, 0, 0), -4.0))
WALL_HEIGHT = 1.7  # y at which the walls end; above them is sky
SPHERES = 10
TO_LIGHT = np.array([0.5, 0.8, 0.33])  # nearly of length 1
# Shares of the pixels whose sample has any light.
HIT_DIRECT = 0.5
HIT_INDIRECT = 0.2
SEED = 0


def spheres(index: int) -> tuple[Array, Array]:
    """Centres (N, 3) and radii (N,) in frame `index`. Every second sphere moves in a circle and hides others."""
    rng = np.random.default_rng(SEED)
    centres = rng.uniform((-3.5, -1.2, -5.5), (3.5, 1.5, -1.0), (SPHERES, 3))
    angle = 0.08 * index + rng.uniform(0, 2 * np.pi, SPHERES)
    centres[::2, :2] += 0.6 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[::2]
    return centres, rng.uniform(0.25, 0.7, SPHERES)


def view(index: int, height: int, width: int) -> View:
    """The view of frame `index`: camera and spheres move, planes are static; a sphere's rest pose is at the origin."""
    eye = np.array([0.02 * index - 0.5, 0.3, 3.0])
    poses = np.tile(np.eye(4), (len(PLANES) + SPHERES, 1, 1))
    poses[len(PLANES) :, :3, 3] = spheres(index)[0]
    return View(intrinsics(70.0, height, width), look_at(eye, np.array([0.01 * index, 0.0, -3.0])), poses)


def cast(pixels: Array, index: int, view: View) -> tuple[Array, NDArray[np.int64], Array]:
    """First hits of rays through `pixels` (..., 2) in frame `index`, whose view is `view`.

    Their depth (...,) along the viewing axis and mesh ID (...,), both 0 for sky, and normal (..., 3) in the world.
    """
    eye = view.camera_to_world[:3, 3]
    ray = directions(pixels, view)  # of length 1 along the viewing axis: t is the depth
    depth = np.full(ray.shape[:-1], np.inf)
    mesh_id = np.zeros(ray.shape[:-1], np.int64)
    normal = np.zeros_like(ray)

    def meet(mesh: int, t: Array, n: Array) -> None:
        """Store a mesh hit at t (...,), with normals n that broadcast to (..., 3), where it is nearest so far."""
        nearer = (t > 0) & (t < depth)
        depth[nearer] = t[nearer]
        mesh_id[nearer] = mesh
        normal[nearer] = np.broadcast_to(n, ray.shape)[nearer]

    with np.errstate(divide="ignore", invalid="ignore"):  # rays along a plane, or past a sphere: inf or NaN, no hit
        for mesh, (n, offset) in enumerate(PLANES, 1):
            t = (offset - eye @ n) / (ray @ np.array(n, float))
            meet(mesh, np.where(eye[1] + t * ray[..., 1] < WALL_HEIGHT, t, np.inf), np.array(n, float))
        for mesh, (centre, radius) in enumerate(zip(*spheres(index), strict=True), 1 + len(PLANES)):
            from_centre = eye - centre
            a = (ray**2).sum(axis=-1)
            b = ray @ from_centre
            t = (-b - np.sqrt(b**2 - a * (from_centre @ from_centre - radius**2))) / a
            meet(mesh, t, (eye + t[..., None] * ray - centre) / radius)
    return np.where(mesh_id > 0, depth, 0), mesh_id, normal


def synthetic_dual_motion(
    pixels: Array, index: int, mesh_id: NDArray[np.int64], motion: Array, now: View, before: View
) -> Array:
    """Dual motion vectors (H, W, 2) of NTD §3.2; `motion` where nothing was occluded.

    Where another surface was visible at y = x + motion in the previous frame, they point to x_prev = y + x - z, with z
    the position of that surface in this frame.
    """
    height, width = pixels.shape[:2]
    y = pixels + motion
    covering_depth, covering_id, _ = cast(y, index - 1, before)
    # y + x - z - x, with z - y the forward vector of the surface visible at y.
    dual = -motion_vectors(y, covering_depth, covering_id, before, now)
    ends = np.stack([y, pixels + dual])
    inside = ((ends >= 0) & (ends <= (width, height))).all(axis=(0, -1))
    return np.where((inside & (covering_id != mesh_id))[..., None], dual, motion)


def noisy(rng: np.random.Generator, mean: Array, share: float) -> Array:
    """One sample per pixel of light `mean` (H, W, 3): zero outside a `share` of the pixels, log-normal inside."""
    size = (*mean.shape[:2], 1)
    heavy_tailed = rng.lognormal(-0.5, 1.0, size)  # of mean 1
    return mean * np.where(rng.random(size) < share, heavy_tailed / share, 0)


def split_into_buffers(light: Mapping[str, Array], seed: tuple[int, ...]) -> dict[str, Array]:
    """Sample buffers (2, H, W, 3) by channel, of mean `light` (H, W, 3): each pixel is non-zero in one of them."""
    rng = np.random.default_rng(seed)
    buffers = {}
    for name, mean in light.items():
        in_first = rng.random((*mean.shape[:2], 1)) < 0.5
        buffers[SAMPLE_BUFFERS[name]] = 2 * mean * np.stack([in_first, ~in_first])
    return buffers


def synthetic_frame(index: int, height: int, width: int) -> Frame:
    """Frame `index` of an endless deterministic sequence, with all channels but references."""
    pixels = pixel_centres(height, width)
    now = view(index, height, width)
    before = view(max(index - 1, 0), height, width)
    depth, mesh_id, normal = cast(pixels, index, now)
    motion = motion_vectors(pixels, depth, mesh_id, now, before)
    dual = synthetic_dual_motion(pixels, index, mesh_id, motion, now, before) if index else motion

    point = now.camera_to_world[:3, 3] + depth[..., None] * directions(pixels, now)
    centred = point - np.concatenate([np.zeros((1, 3)), now.object_to_world[:, :3, 3]])[mesh_id]
    checker = np.floor(3 * centred + 1e-6).sum(axis=-1) % 2
    rng = np.random.default_rng(SEED)
    colour = rng.uniform(0.2, 0.9, (1 + len(now.object_to_world), 3))[mesh_id]
    hit = (mesh_id > 0)[..., None]
    albedo = np.where(hit, colour * (0.6 + 0.4 * checker[..., None]), 1)
    lit = np.where(hit, albedo * (normal @ TO_LIGHT).clip(0)[..., None], 0)
    rng = np.random.default_rng((SEED, index))
    direct = noisy(rng, 2 * lit, HIT_DIRECT)
    indirect = noisy(rng, np.where(hit, 0.3 * albedo, 0), HIT_INDIRECT)
    distances = [
        np.where(hit & (rng.random(hit.shape) < share), rng.lognormal(0.0, 0.5, hit.shape), 0) for share in (1.0, 0.3)
    ]
    channels = {
        "direct": direct,
        "indirect": indirect,
        **split_into_buffers({"direct": direct, "indirect": indirect}, (SEED, index, 1)),
        "emission": np.where(hit, 0, [0.4, 0.6, 1.0]),
        "albedo": albedo,
        "normal": normal,
        "depth": depth[..., None],
        "roughness": np.where(mesh_id % 3 == 2, 0.2, 1.0)[..., None],
        "mesh_id": mesh_id[..., None],
        "motion": motion,
        "dual_motion": dual,
        "shadow_motion": motion,
        "reflection_motion": motion,
        "gradient": np.zeros_like(motion),
        "hit_distance": np.concatenate(distances, axis=-1),
        "light_distance": np.zeros_like(depth)[..., None],
        "light_angle": np.where(hit, 0.05, 0),
    }
    tensors = {name: to_tensor(array, CHANNELS[name].has_buffers) for name, array in channels.items()}
    return Frame(tensors, Cameras.of(now), Cameras.of(before), "synthetic sequence")
