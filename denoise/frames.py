"""From the pixels of foreign frames to the Frames that denoisers take, with what is missing derived or left out."""

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from datasets import mirrors
from datasets.cameras import Cameras
from datasets.channels import CHANNELS
from datasets.exr import FACTS_ATTRIBUTE, channels_of, view_of_facts
from datasets.frame import Frame, to_tensor
from denoise.cameras import (
    STILL,
    in_the_world,
    is_own_space,
    view_of_header,
    view_of_positions,
)
from denoise.exr_image import ExrImage
from denoise.motion_meaning import Meaning
from denoise.pixels import Pixels
from errors import BadInput
from scenes.camera import Array, View, motion_vectors, pixel_centres, unproject

Image = NDArray[np.float32]

# The previous camera where it is not known what surfaces were in its image: no frame's history follows it.
NOWHERE = View(np.full((3, 3), np.nan), np.full((4, 4), np.nan), np.full((1, 4, 4), np.nan))
TELEPHOTO = 1e8  # px: a focal length that makes all rays parallel


@dataclass(frozen=True)
class Reading:
    """How a sequence's pixels are to be read, which holds for all of its frames.

    Attributes:
        meaning: of its motion vectors; None where there are none.
        normals_are_encoded: in [0, 1] instead of [-1, 1].
        cameras: what tells them, "positions", "header" or "arrays" beside the pixels; None where nothing does.
        in_camera_space: whether positions and normals are in the camera's own coordinates.
    """

    meaning: Meaning | None = None
    normals_are_encoded: bool = False
    cameras: str | None = None
    in_camera_space: bool = False

    @property
    def has_history(self) -> bool:
        """Whether it is known where surfaces were in the previous frame."""
        return self.meaning is not None or self.cameras is not None


def encoded(normals: Image, surface: NDArray[np.bool_]) -> bool:
    """Whether normals (H, W, 3) are scaled to [0, 1], as 8-bit tools like them."""
    shown = normals[surface & (normals != 0).any(axis=-1)]
    if len(shown) == 0 or shown.min() < -1e-3:
        return False
    off_unit = [np.abs(np.linalg.norm(n, axis=-1) - 1).mean() for n in (shown, 2 * shown - 1)]
    return bool(off_unit[1] < off_unit[0])


@dataclass(frozen=True)
class Sighting:
    """What is known of the camera of one frame: its view of the world, and of the coordinates of its positions."""

    world: View
    own: View | None  # by which positions become depths


def sighting(pixels: Pixels, reading: Reading) -> Sighting | None:
    """The camera of a frame; None where it cannot be told."""
    if pixels.view is not None:
        return Sighting(pixels.view, None)
    if reading.cameras == "header":
        view = view_of_header(pixels.header, *pixels.size)
        return Sighting(view, None) if view else None
    if reading.cameras == "positions":
        own = view_of_positions(pixels.arrays["position"], pixels.surface)
        world = own and (in_the_world(own, pixels.header) if reading.in_camera_space else own)
        return Sighting(world, own) if world else None
    return None


def camera_kind(pixels: Pixels) -> Reading:
    """What tells the cameras of a sequence that begins with this frame. Positions are believed before the header."""
    if "position" in pixels.arrays:
        own = view_of_positions(pixels.arrays["position"], pixels.surface)
        header = pixels.header
        if own and is_own_space(own, header, pixels.arrays["position"], pixels.surface):
            moved = in_the_world(own, header)
            return Reading(cameras="positions" if moved else None, in_camera_space=True)
        if own:
            return Reading(cameras="positions")
    has_depth = "depth" in pixels.arrays or "distance" in pixels.arrays  # without, a camera tells nothing of surfaces
    return Reading(cameras="header" if has_depth and view_of_header(pixels.header, *pixels.size) else None)


class Shot:
    """The frames between two cuts, one after another: what a frame needs of the one before is kept here.

    Raises BadInput where `spp` are no samples a pixel.
    """

    def __init__(self, reading: Reading, reads: tuple[str, ...], source: str, spp: float = 1.0):
        if not 0 < spp < math.inf:
            raise BadInput(f"{spp:g} spp are no samples: frames have one a pixel, or a few")
        self.reading = reading
        self.reads = reads
        self.source = source
        self.spp = spp
        self.view: View | None = None  # of the frame before
        self.depth: Image | None = None  # of the frame before, (H, W)
        self.seen = False  # whether that frame's camera was known

    def frame(self, pixels: Pixels) -> Frame:
        """The next Frame."""
        seen = sighting(pixels, self.reading)
        if (seen is not None) != self.seen:  # cameras are lost or found again: nothing leads from one to the other
            self.view = None
            self.seen = seen is not None
            if not self.seen:
                tqdm.write(f"{pixels.source} tells no camera, unlike the frames before it: history begins anew")
        depth = depth_of(pixels, seen)
        given = self.given_motion(pixels)
        view = seen.world if seen else self.parallel_view(pixels, depth, given)
        before = self.view if self.view is not None else view
        motion = derived_motion(pixels, depth, view, before) if given is None else given
        channels = {
            **light_of(pixels),
            "albedo": pixels.arrays.get("albedo", np.ones((*pixels.size, 3), np.float32)),
            "normal": self.normals(pixels, depth, view, seen),
            "depth": depth[..., None],
            "roughness": pixels.arrays.get("roughness", np.ones((*pixels.size, 1), np.float32)),
            "mesh_id": pixels.surface[..., None],
            "motion": motion,
            "dual_motion": motion,
        }
        self.view = view
        self.depth = depth
        return Frame(
            {name: to_tensor(channels[name], CHANNELS[name].has_buffers) for name in self.reads if name in channels},
            now=Cameras.of(view),
            previous=Cameras.of(before if self.reading.has_history else NOWHERE),
            source=self.source,
            spp=torch.full((1, 1, 1, 1), self.spp * (2 if "half" in pixels.arrays else 1)),
        )

    def given_motion(self, pixels: Pixels) -> Image | None:
        """The renderer's motion (H, W, 2) in our convention; 0 in the first frame, None where there is none."""
        if self.reading.meaning is None:
            return None
        motion = self.reading.meaning.pixels(pixels.arrays["motion"])
        return motion if self.view is not None else np.zeros_like(motion)

    def given_normal(self, pixels: Pixels) -> Image | None:
        """The renderer's normals (H, W, 3) in [-1, 1]; None where there are none."""
        normal = pixels.arrays.get("normal")
        return 2 * normal - 1 if normal is not None and self.reading.normals_are_encoded else normal

    def parallel_view(self, pixels: Pixels, depth: Image, motion: Image | None) -> View:
        """A view for frames without cameras: from so far that all rays are parallel.

        Reprojection then compares depths along one axis alone. So that a camera that comes closer keeps its history,
        this one moves along that axis as far as the median of depths changes from the previous frame to this one.
        """
        height, width = pixels.size
        K = np.array([[-TELEPHOTO, 0, width / 2], [0, -TELEPHOTO, height / 2], [0, 0, 1.0]])
        if self.view is None:
            return View(K, facing(self.given_normal(pixels), pixels.surface), STILL)
        pose = self.view.camera_to_world.copy()
        if motion is not None and self.depth is not None and self.depth.shape == depth.shape:
            pose[:3, 3] += pose[:3, 2] * depth_change(depth, self.depth, motion)
        return View(K, pose, STILL)

    def normals(self, pixels: Pixels, depth: Image, view: View, seen: Sighting | None) -> Image:
        """Unit normals (H, W, 3) in the world; 0 for background."""
        toward_viewer = -view.camera_to_world[:3, 2]
        given = self.given_normal(pixels)
        normal: NDArray[Any]
        if given is not None:
            normal = given
            if self.reading.in_camera_space and seen and seen.own:
                normal = normal @ (view.camera_to_world[:3, :3] @ seen.own.camera_to_world[:3, :3].T).T
        elif seen:
            points = unproject(pixel_centres(*pixels.size), depth.astype(np.float64), view)
            normal = facet_normals(points, view)
        else:
            normal = np.broadcast_to(toward_viewer, (*pixels.size, 3))
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        unit = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), toward_viewer)
        return np.where(pixels.surface[..., None], unit, 0).astype(np.float32)


def derived_motion(pixels: Pixels, depth: Image, view: View, before: View) -> Image:
    """Motion (H, W, 2) of a world in which nothing moves but the camera."""
    mesh_id = pixels.surface.astype(np.int64)
    vectors = motion_vectors(pixel_centres(*pixels.size), depth.astype(np.float64), mesh_id, view, before)
    return vectors.astype(np.float32)


def light_of(pixels: Pixels) -> dict[str, Image]:
    """Radiance as our channels: what is reflected is direct. Background is emission, which nobody filters.

    Raises BadInput for two halves that are one: their difference would say that there is no noise.
    """
    surface = pixels.surface[..., None]
    colour = pixels.arrays["colour"]
    halves = np.stack([colour, pixels.arrays["half"]]) if "half" in pixels.arrays else None
    if halves is not None:
        if colour[pixels.surface].any() and np.array_equal(*halves):
            raise BadInput(f"{pixels.source} and its other half are the same: render them with different seeds")
        colour = halves.mean(axis=0)
    emitted = pixels.arrays.get("emission", np.zeros_like(colour))
    light = {
        "direct": np.where(surface, colour - emitted, 0),
        "indirect": np.zeros_like(colour),
        "emission": np.where(surface, emitted, colour),
    }
    if halves is not None:
        light["direct_halves"] = np.where(surface, halves - emitted, 0)
        light["indirect_halves"] = np.zeros_like(halves)
    return light


def depth_of(pixels: Pixels, seen: Sighting | None) -> Image:
    """Depth (H, W) along the viewing axis, 0 for background; 1 for all surfaces where nothing tells it."""
    depth: NDArray[Any]
    if seen and seen.own:
        eye = seen.own.camera_to_world[:3, 3]
        forward = seen.own.camera_to_world[:3, 2]
        depth = (np.where(pixels.surface[..., None], pixels.arrays["position"], 0) - eye) @ forward
    elif "depth" in pixels.arrays:
        depth = pixels.arrays["depth"][..., 0]
    elif "distance" in pixels.arrays:
        depth = pixels.arrays["distance"][..., 0]
        if seen:
            depth = depth / np.linalg.norm(rays_of(seen.world, *pixels.size), axis=-1)
    elif "position" in pixels.arrays and pixels.surface.any():
        depth = np.linalg.norm(np.where(pixels.surface[..., None], pixels.arrays["position"], 0), axis=-1)
    else:
        depth = np.ones(pixels.size)
    # A surface behind a fitted camera can only be an error of the fit; it must not become background.
    return np.where(pixels.surface, np.maximum(depth, 1e-6), 0).astype(np.float32)


def rays_of(view: View, height: int, width: int) -> Array:
    """Directions (H, W, 3) through all pixels, of length 1 along the viewing axis."""
    pixels = pixel_centres(height, width)
    return np.concatenate([(pixels - view.K[:2, 2]) / np.diag(view.K)[:2], np.ones((height, width, 1))], axis=-1)


def facing(normal: Image | None, surface: NDArray[np.bool_]) -> Array:
    """A pose (4, 4) in the origin that looks against the mean of the visible normals, or along z without any.

    Depths are compared along this axis: no surface that is seen, but for grazing ones, must lie along it.
    """
    mean = normal[surface].mean(axis=0, dtype=np.float64) if normal is not None and surface.any() else None
    pose = np.eye(4)
    if mean is not None and np.linalg.norm(mean) > 1e-3:
        forward = -mean / np.linalg.norm(mean)
        side = np.eye(3)[np.argmin(np.abs(forward))]
        left = np.cross(side, forward)
        left /= np.linalg.norm(left)
        pose[:3, :3] = np.stack([left, np.cross(forward, left), forward], axis=1)
    return pose


def depth_change(depth: Image, before: Image, motion: Image) -> float:
    """The median of what depth (H, W) was where motion leads, minus what it is; 0 where nothing tells."""
    height, width = depth.shape
    stride = max(1, min(height, width) // 256)
    rows, columns = np.mgrid[:height:stride, :width:stride]
    x = columns + motion[rows, columns, 0]
    y = rows + motion[rows, columns, 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    there = before[np.rint(y[inside]).astype(np.int64), np.rint(x[inside]).astype(np.int64)]
    here = depth[rows, columns][inside]
    both = (there > 0) & (here > 0)
    return float(np.median(there[both] - here[both])) if both.any() else 0.0


def facet_normals(points: Array, view: View) -> Array:
    """Normals (H, W, 3), not of unit length, of the surface through `points` (H, W, 3), toward the viewer.

    Along rows and columns the smaller step to a neighbour counts: the larger one may lead across an edge.
    """
    normal: Array = np.cross(smaller_step(points, 1), smaller_step(points, 0))
    toward = ((view.camera_to_world[:3, 3] - points) * normal).sum(axis=-1, keepdims=True)
    return np.where(toward < 0, -normal, normal)


def smaller_step(points: Array, axis: int) -> Array:
    """Differences (H, W, 3) to the nearer neighbour along an axis, 0 in images of one pixel."""
    if points.shape[axis] < 2:
        return np.zeros_like(points)
    steps = np.diff(points, axis=axis)
    ahead = np.concatenate([steps, np.take(steps, [-1], axis)], axis=axis)
    behind = np.concatenate([np.take(steps, [0], axis), steps], axis=axis)
    nearer = np.linalg.norm(ahead, axis=-1, keepdims=True) < np.linalg.norm(behind, axis=-1, keepdims=True)
    return np.where(nearer, ahead, behind)


class OwnShot:
    """As Shot, of frames that `onespp exr` wrote: all channels and cameras are there, exactly."""

    def __init__(self, reads: tuple[str, ...]):
        self.reads = reads
        self.view: View | None = None

    def frame(self, image: ExrImage) -> Frame:
        """The next Frame. A channel that was not exported is missing in it."""
        facts: dict[str, Any] = json.loads(image.header[FACTS_ATTRIBUTE])
        view = view_of_facts(facts)
        arrays = channels_of({name: channel.pixels for name, channel in image.channels.items()})
        before = self.view if self.view is not None else view
        self.view = view
        return Frame(
            {
                name: to_tensor(mirrors.visible(name, arrays, arrays.__getitem__), CHANNELS[name].has_buffers)
                for name in self.reads
                if name in arrays
            },
            now=Cameras.of(view),
            previous=Cameras.of(before),
            source=str(image.path),
            spp=torch.full((1, 1, 1, 1), float(facts["noisy_spp"])),
        )
