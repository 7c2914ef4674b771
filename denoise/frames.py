"""From foreign frames to the Frames that denoisers take, with what is missing derived or left out."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.cameras import Cameras
from datasets.channels import CHANNELS
from datasets.clip import second_layer_of, visible_channel, visible_view
from datasets.exr import FACTS_ATTRIBUTE, channels_in
from datasets.frame import Frame, to_tensor
from denoise.cameras import in_the_world, is_own_space, view_of_header, view_of_positions
from denoise.exr_image import ExrImage
from denoise.foreign_frame import ForeignFrame, Image
from denoise.motion_convention import MotionConvention
from errors import BadInput
from scenes.camera import STILL, Array, View, look_at, motion_vectors, pixel_centres, unproject

# The previous camera where it is unknown which surfaces were in its image: no frame's history follows it.
NOWHERE = View(np.full((3, 3), np.nan), np.full((4, 4), np.nan), np.full((1, 4, 4), np.nan))
TELEPHOTO = 1e8  # px: a focal length that makes all rays parallel


@dataclass(frozen=True)
class InputConventions:
    motion: MotionConvention | None = None  # None where there are no motion vectors
    normals_are_encoded: bool = False  # in [0, 1] instead of [-1, 1]
    cameras: str | None = None  # from "positions", "header" or "arrays" beside the pixels; None where unknown
    in_camera_space: bool = False  # whether positions and normals are in the camera's own coordinates
    albedo_is_sampled: bool = False  # whether albedo has the frame's few samples, and so is averaged over frames

    @property
    def has_history(self) -> bool:
        """Whether positions of surfaces in the previous frame are available."""
        return self.motion is not None or self.cameras is not None


def check_reads(name: str, reads: Sequence[str]) -> None:
    """Raise BadInput, naming the denoiser, where it `reads` channels that no other renderer has."""
    if ours := [channel for channel in reads if CHANNELS[channel].renderer_only]:
        raise BadInput(f"{name} reads {', '.join(ours)}, which only onespp renders: use another, such as svgf")


def are_encoded(normals: Image, surface: NDArray[np.bool_]) -> bool:
    """Whether normals (H, W, 3) are scaled to [0, 1], as for 8-bit images."""
    shown = normals[surface & (normals != 0).any(axis=-1)]
    if len(shown) == 0 or shown.min() < -1e-3:
        return False
    off_unit = [np.abs(np.linalg.norm(n, axis=-1) - 1).mean() for n in (shown, 2 * shown - 1)]
    return bool(off_unit[1] < off_unit[0])


class FrameViews(NamedTuple):
    world: View
    positions: View | None  # by which positions become depths


def views_of(frame: ForeignFrame, conventions: InputConventions) -> FrameViews | None:
    """The camera of a frame; None where it is unknown."""
    if conventions.cameras == "arrays" and frame.view is not None:
        return FrameViews(frame.view, None if frame.has_depth else frame.view)
    if conventions.cameras == "header":
        view = view_of_header(frame.header, *frame.size)
        return FrameViews(view, None) if view else None
    if conventions.cameras == "positions":
        own = view_of_positions(frame.arrays["position"], frame.surface)
        world = own and (in_the_world(own, frame.header) if conventions.in_camera_space else own)
        return FrameViews(world, own) if world else None
    return None


def camera_conventions(first: ForeignFrame, others: Iterable[ForeignFrame] = ()) -> InputConventions:
    """Where the cameras of a sequence come from, by its first frames. Positions are preferred to the header.

    `others` are read as long as positions may be in the camera's own space, or show one plane alone: a camera in the
    world may begin at the origin, or before a wall.
    """
    in_camera_space: InputConventions | None = None
    for frame in chain([first], others) if "position" in first.arrays else ():
        own = view_of_positions(frame.arrays["position"], frame.surface)
        if own and not is_own_space(own, frame.header, frame.arrays["position"], frame.surface):
            return InputConventions(cameras="positions")
        if own and not in_camera_space:
            moved = in_the_world(own, frame.header)
            in_camera_space = InputConventions(cameras="positions" if moved else None, in_camera_space=True)
    # Without depth, a camera does not locate surfaces.
    has_camera = first.has_depth and view_of_header(first.header, *first.size)
    return in_camera_space or InputConventions(cameras="header" if has_camera else None)


class FrameBuilder:
    """Makes the Frames between two cuts, one after another. Raises BadInput where `spp` is no number of samples."""

    def __init__(self, conventions: InputConventions, reads: tuple[str, ...], source: str, spp: float = 1.0):
        if not 0 < spp < math.inf:
            raise BadInput(f"{spp:g} is not a number of samples per pixel: frames have one or more")
        self.conventions = conventions
        self.reads = reads
        self.source = source
        self.spp = spp
        # Of the frame before:
        self.view: View | None = None
        self.depth: Image | None = None  # (H, W)
        self.had_camera = False

    def build(self, foreign: ForeignFrame) -> Frame:
        views = views_of(foreign, self.conventions)
        if (views is not None) != self.had_camera:  # motion between a known and an unknown camera is unknown
            self.view = None
            self.had_camera = views is not None
            if not self.had_camera:
                tqdm.write(f"{foreign.source} has no camera, unlike the frames before it: history begins anew")
        depth = depth_of(foreign, views)
        given: Image | None = None  # the renderer's motion (H, W, 2) in our convention; 0 in the first frame
        if self.conventions.motion is not None:
            given = self.conventions.motion.pixels(foreign.arrays["motion"])
            given = given if self.view is not None else np.zeros_like(given)
        view = views.world if views else self.parallel_view(foreign, depth, given)
        has_history = given is not None or views is not None
        before = self.view if self.view is not None and has_history else view
        motion = given
        if motion is None:  # of a world in which nothing moves but the camera
            pixels, mesh_id = pixel_centres(*foreign.size), foreign.surface.astype(np.int64)
            motion = motion_vectors(pixels, depth.astype(np.float64), mesh_id, view, before).astype(np.float32)
        channels = {
            **light_of(foreign),
            "albedo": foreign.arrays.get("albedo", np.ones((*foreign.size, 3), np.float32)),
            "normal": self.normals(foreign, depth, view, views),
            "depth": depth[..., None],
            "roughness": foreign.arrays.get("roughness", np.ones((*foreign.size, 1), np.float32)),
            "mesh_id": mesh_ids(foreign),
            "motion": motion,
            "dual_motion": motion,
        }
        self.view = view
        self.depth = depth
        previous = before if has_history else NOWHERE
        spp = self.spp * (2 if "buffer_b" in foreign.arrays else 1)
        return frame_of(channels, self.reads, view, previous, self.source, spp)

    def given_normal(self, foreign: ForeignFrame) -> Image | None:
        """The renderer's normals (H, W, 3) in [-1, 1]; None where there are none."""
        normal = foreign.arrays.get("normal")
        return 2 * normal - 1 if normal is not None and self.conventions.normals_are_encoded else normal

    def parallel_view(self, foreign: ForeignFrame, depth: Image, motion: Image | None) -> View:
        """A view for frames without cameras: from so far that all rays are parallel.

        Reprojection then compares depths along one axis alone. So that a camera that comes closer keeps its history,
        this one moves along that axis as far as the median of depths changes from the previous frame to this one.
        Without history, each frame has a view of its own.
        """
        height, width = foreign.size
        K = np.array([[-TELEPHOTO, 0, width / 2], [0, -TELEPHOTO, height / 2], [0, 0, 1.0]])
        if self.view is None or motion is None:
            return View(K, facing_pose(self.given_normal(foreign), foreign.surface), STILL)
        pose = self.view.camera_to_world.copy()
        if self.depth is not None and self.depth.shape == depth.shape:
            pose[:3, 3] += pose[:3, 2] * depth_change(depth, self.depth, motion)
        return View(K, pose, STILL)

    def normals(self, foreign: ForeignFrame, depth: Image, view: View, views: FrameViews | None) -> Image:
        """Unit normals (H, W, 3) in the world; 0 for background."""
        toward_viewer = -view.camera_to_world[:3, 2]
        given = self.given_normal(foreign)
        normal: NDArray[Any]
        if given is not None:
            normal = given
            if self.conventions.in_camera_space and views and views.positions:
                normal = normal @ (view.camera_to_world[:3, :3] @ views.positions.camera_to_world[:3, :3].T).T
        elif views:
            normal = facet_normals(unproject(pixel_centres(*foreign.size), depth.astype(np.float64), view), view)
        else:
            normal = np.broadcast_to(toward_viewer, (*foreign.size, 3))
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        unit = np.where(length > 1e-6, normal / np.maximum(length, 1e-6), toward_viewer)
        return np.where(foreign.surface[..., None], unit, 0).astype(np.float32)


def facing_pose(normal: Image | None, surface: NDArray[np.bool_]) -> Array:
    """A pose (4, 4) in the origin that looks against the mean of the visible normals, or along z without any.

    Depths are compared along this axis: no visible surface, but for grazing ones, must lie along it.
    """
    mean = normal[surface].mean(axis=0, dtype=np.float64) if normal is not None and surface.any() else np.zeros(3)
    length = np.linalg.norm(mean)
    return look_at(np.zeros(3), -mean, np.eye(3)[np.argmin(np.abs(mean / length))]) if length > 1e-3 else np.eye(4)


def depth_change(depth: Image, before: Image, motion: Image) -> float:
    """The median of the previous depth (H, W) at the end of each motion vector minus depth; 0 without surfaces."""
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


def mesh_ids(foreign: ForeignFrame) -> Image:
    """Ids (H, W, 1) of surfaces, 0 for background: hashes of the renderer's, below 2^24, or 1 for all without any."""
    if "id" not in foreign.arrays:
        return foreign.surface[..., None].astype(np.float32)
    bits = np.ascontiguousarray(foreign.arrays["id"], np.float32).view(np.uint32)
    hashed = (bits * np.uint32(0x9E3779B1)) >> 8  # Fibonacci hashing: ids may be small integers or random bits
    return np.where(foreign.surface[..., None], np.maximum(hashed, 1), 0).astype(np.float32)


def frame_of(
    channels: dict[str, Any], reads: Sequence[str], view: View, previous: View, source: str, spp: float
) -> Frame:
    """A Frame with those of the `channels`, arrays (H, W, C) or (2, H, W, C), that a denoiser `reads`."""
    return Frame(
        {name: to_tensor(channels[name], CHANNELS[name].has_buffers) for name in reads if name in channels},
        now=Cameras.of(view),
        previous=Cameras.of(previous),
        source=source,
        spp=torch.full((1, 1, 1, 1), spp),
    )


def light_of(foreign: ForeignFrame) -> dict[str, Image]:
    """Radiance as our channels: all reflected light is direct. Background is emission, which is never filtered.

    Raises BadInput for two equal sample buffers: their difference would mean that there is no noise.
    """
    surface = foreign.surface[..., None]
    colour = foreign.arrays["colour"]
    buffers = np.stack([colour, foreign.arrays["buffer_b"]]) if "buffer_b" in foreign.arrays else None
    if buffers is not None:
        if colour[foreign.surface].any() and np.array_equal(*buffers):
            raise BadInput(f"{foreign.source} and its other half are the same: render them with different seeds")
        colour = buffers.mean(axis=0)
    emitted = foreign.arrays.get("emission", np.zeros_like(colour))
    light = {
        "direct": np.where(surface, colour - emitted, 0),
        "indirect": np.zeros_like(colour),
        "emission": np.where(surface, emitted, colour),
    }
    if buffers is not None:
        light["direct_buffers"] = np.where(surface, buffers - emitted, 0)
        light["indirect_buffers"] = np.zeros_like(buffers)
    return light


def depth_of(foreign: ForeignFrame, views: FrameViews | None) -> Image:
    """Depth (H, W) along the viewing axis, 0 for background; 1 for all surfaces where it is unknown."""
    depth: NDArray[Any]
    if views and views.positions:
        pose = views.positions.camera_to_world
        depth = (np.where(foreign.surface[..., None], foreign.arrays["position"], 0) - pose[:3, 3]) @ pose[:3, 2]
    elif "depth" in foreign.arrays:
        depth = foreign.arrays["depth"][..., 0]
    elif "distance" in foreign.arrays:
        depth = foreign.arrays["distance"][..., 0]
        if views:
            K = views.world.K
            in_camera = (pixel_centres(*foreign.size) - K[:2, 2]) / np.diag(K)[:2]  # rays, of length 1 along the axis
            depth = depth / np.linalg.norm(np.concatenate([in_camera, np.ones((*foreign.size, 1))], axis=-1), axis=-1)
    elif "position" in foreign.arrays and foreign.surface.any():
        depth = np.linalg.norm(np.where(foreign.surface[..., None], foreign.arrays["position"], 0), axis=-1)
    else:
        depth = np.ones(foreign.size)
    # A surface behind a fitted camera can only be an error of the fit; it must not become background.
    return np.where(foreign.surface, np.maximum(depth, 1e-6), 0).astype(np.float32)


class OwnFrameBuilder:
    """Like FrameBuilder, of frames that `onespp exr` wrote: all channels and cameras are there, exactly."""

    def __init__(self, reads: tuple[str, ...]):
        self.reads = reads
        self.view: View | None = None  # of the frame before

    def build(self, image: ExrImage) -> tuple[Frame, int]:
        """The next Frame, and how many pixels were not finite. A channel that was not exported is missing in it."""
        facts: dict[str, Any] = json.loads(image.header[FACTS_ATTRIBUTE])
        arrays = channels_in({name: channel.pixels for name, channel in image.channels.items()})
        own_view = View._make(np.array(facts[key]) for key in View._fields)
        view, meshes = visible_view(own_view, arrays), len(own_view.object_to_world)
        names = list(dict.fromkeys([*self.reads, *second_layer_of(self.reads, arrays)]))
        visible = {name: visible_channel(name, arrays, arrays.__getitem__, meshes) for name in names if name in arrays}
        before = self.view if self.view is not None else view
        self.view = view
        frame = frame_of(visible, names, view, before, str(image.path), float(facts["noisy_spp"]))
        tensors = [tensor.flatten(1, -3) for tensor in frame.channels.values()]  # sample buffers are images too
        bad = [~torch.isfinite(tensor).all(dim=1) for tensor in tensors]
        return frame, int(torch.stack(bad).any(dim=0).sum())
