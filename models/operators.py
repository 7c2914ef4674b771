"""Operators that denoisers share. Tensors are (B, C, H, W), float32."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.channels import LUMINANCE_WEIGHTS
from datasets.frame import Cameras, Frame
from models import compiled

BACKGROUND = 0  # mesh id


def finite(x: Tensor) -> Tensor:
    """NaN and infinities become 0, so that one bad pixel cannot poison a filter or a state."""
    return torch.nan_to_num(x, nan=0.0, posinf=0.0, neginf=0.0)


def luminance(rgb: Tensor) -> Tensor:
    """Rec. 709 luminance (B, 1, H, W)."""
    return (rgb * torch.tensor(LUMINANCE_WEIGHTS, dtype=torch.float64).to(rgb)[:, None, None]).sum(dim=1, keepdim=True)


def pad(x: Tensor, multiple: int) -> Tensor:
    """Replicate the right and bottom borders until both sides are multiples of `multiple`."""
    right, bottom = -x.shape[-1] % multiple, -x.shape[-2] % multiple
    return F.pad(x, (0, right, 0, bottom), mode="replicate") if right or bottom else x


@dataclass(frozen=True)
class Surfaces:
    """The G-buffer that reprojection tests taps against."""

    depth: Tensor  # (B, 1, H, W)
    normal: Tensor  # (B, 3, H, W), world space
    mesh_id: Tensor  # (B, 1, H, W)

    @staticmethod
    def of(frame: Frame) -> "Surfaces":
        return Surfaces(frame.depth, frame.normal, frame.mesh_id)

    def packed(self) -> Tensor:
        return torch.cat([self.depth, self.normal, self.mesh_id], dim=1)


def rays(K: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Directions (..., 3) in the camera frame, of unit length along the viewing axis, through pixels at x, y (...)."""
    K = K.to(x)
    return torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], dim=-1)


def rigid_inverse(matrix: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4)."""
    inverse = torch.zeros_like(matrix)
    inverse[..., :3, :3] = matrix[..., :3, :3].mT
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ matrix[..., :3, 3:]
    inverse[..., 3, 3] = 1
    return inverse


def to_previous_camera(now: Cameras, previous: Cameras, item: int) -> Tensor:
    """Transforms (M + 1, 4, 4) by mesh id: from this frame's camera to the previous one's, along with the mesh.

    Products are taken in float64 and camera to camera, so that scenes far from the origin keep their precision.
    """
    to_world, from_world = now.camera_to_world[item], rigid_inverse(previous.camera_to_world[item])
    moved = previous.object_to_world[item] @ rigid_inverse(now.object_to_world[item])
    still = torch.eye(4, dtype=moved.dtype, device=moved.device)[None]
    return from_world @ torch.cat([still, moved]) @ to_world


PLANE_TOLERANCE = 0.01  # of the depth: a tap's surface may lie this far off the point's plane
NORMAL_TOLERANCE = 0.9  # smallest cosine between a tap's normal and the point's


class Reprojection:
    """Fetches the history of every pixel of one batch item by its motion vector (SVGF §4.1).

    A bilinear filter of 2 x 2 taps, each tested on depth, normal and mesh id; the weights of failed taps are spread
    uniformly over the consistent ones; without any, a 3 x 3 box is tried; without any there, the pixel is disoccluded.
    """

    def __init__(self, frame: Frame, history: Tensor, surfaces: Surfaces, item: int):
        self.height, self.width = frame.size
        self.history = history[item].flatten(1)  # (C, H W)
        self.then = surfaces.packed()[item].flatten(1)  # (5, H W)
        self.previous_K = frame.previous.K[item]
        motion, now = frame.motion[item], Surfaces.of(frame)
        mesh = now.mesh_id[item, 0].long().flatten()
        depth, normal = now.depth[item, 0].flatten(), now.normal[item].flatten(1)

        y, x = torch.meshgrid(
            torch.arange(self.height, device=motion.device) + 0.5,
            torch.arange(self.width, device=motion.device) + 0.5,
            indexing="ij",
        )
        self.position = torch.stack([x + motion[0], y + motion[1]]).flatten(1)  # (2, H W), in the previous frame
        self.mesh = mesh
        # Where each surface point and its normal are expected, in the previous camera's frame.
        matrix = to_previous_camera(frame.now, frame.previous, item).to(motion)[mesh]
        ray = rays(frame.now.K[item], x.flatten(), y.flatten())
        point = torch.einsum("nij,nj->ni", matrix[:, :3, :3], depth[:, None] * ray) + matrix[:, :3, 3]
        world_to_camera = frame.now.camera_to_world[item, :3, :3].T.to(motion)
        self.point = point  # (H W, 3)
        self.normal = torch.einsum("nij,jk,kn->ni", matrix[:, :3, :3], world_to_camera, normal)
        self.world_to_previous = frame.previous.camera_to_world[item, :3, :3].T.to(motion)

    def taps(self, pixels: Tensor, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
        """History (C, K, n) at taps (K, n) for the n `pixels` (indices), and whether each tap is consistent (K, n)."""
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        index = row.clamp(0, self.height - 1) * self.width + column.clamp(0, self.width - 1)
        depth, normal, mesh = self.then[0, index], self.then[1:4, index], self.then[4, index]
        normal = torch.einsum("ij,jkn->kni", self.world_to_previous, normal)
        seen = depth[..., None] * rays(self.previous_K, column + 0.5, row + 0.5)
        expected = self.point[pixels]
        off_plane = ((expected - seen) * normal).sum(dim=-1).abs()
        same_plane = off_plane <= PLANE_TOLERANCE * depth
        same_normal = (normal * self.normal[pixels]).sum(dim=-1) >= NORMAL_TOLERANCE
        background = self.mesh[pixels] == BACKGROUND
        return self.history[:, index], inside & (mesh == self.mesh[pixels]) & (background | same_plane & same_normal)

    def bilinear(self) -> tuple[Tensor, Tensor]:
        """History (C, H W) and whether it was found (H W,)."""
        x, y = self.position[0] - 0.5, self.position[1] - 0.5
        # Far outside the image an index would overflow; any place outside is as good.
        x, y = x.clamp(-2, self.width + 1), y.clamp(-2, self.height + 1)
        column, row = x.floor(), y.floor()
        fx, fy = x - column, y - row
        shift = torch.tensor([[0, 1, 0, 1], [0, 0, 1, 1]], device=x.device)
        weight = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
        everything = torch.arange(x.numel(), device=x.device)
        column, row = column.long() + shift[0][:, None], row.long() + shift[1][:, None]
        history, consistent = self.taps(everything, column, row)
        count = consistent.sum(dim=0)
        failed = (weight * ~consistent).sum(dim=0)
        weight = torch.where(consistent, weight + failed / count.clamp(min=1), 0)
        return (history * weight).sum(dim=1), count > 0

    def box(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """History (C, n) and whether it was found (n,) for the n `pixels`, from the 3 x 3 taps around the position."""
        centre = self.position[:, pixels].clamp(-2, max(self.height, self.width) + 1).floor().long()
        around = torch.arange(-1, 2, device=pixels.device)
        shift_y, shift_x = torch.meshgrid(around, around, indexing="ij")
        column, row = centre[0] + shift_x.flatten()[:, None], centre[1] + shift_y.flatten()[:, None]
        history, consistent = self.taps(pixels, column, row)
        count = consistent.sum(dim=0)
        return (history * consistent).sum(dim=1) / count.clamp(min=1), count > 0

    def fetch(self) -> tuple[Tensor, Tensor]:
        """History (C, H, W), 0 where none was found, and whether it was found (1, H, W)."""
        history, found = self.bilinear()
        lost = torch.nonzero(~found).flatten()
        if len(lost):
            history[:, lost], found[lost] = self.box(lost)
        return (history * found).view(-1, self.height, self.width), found.view(1, self.height, self.width)


def fetch_compiled(frame: Frame, history: Tensor, surfaces: Surfaces, item: int) -> tuple[Tensor, Tensor]:
    """What Reprojection.fetch returns, by the compiled kernel; in the world's axes around the previous eye."""
    from models.compiled.reproject import fetch

    now, previous = frame.now, frame.previous
    K, K_then = now.K[item], previous.K[item]
    to_world, then_to_world = now.camera_to_world[item, :3, :3], previous.camera_to_world[item, :3, :3]
    to_then = to_previous_camera(now, previous, item)[:, :3]
    to_then = then_to_world @ to_then
    turn = to_then[..., :3] @ to_world.T
    slopes = torch.stack([1 / K.diagonal()[:2], -K[:2, 2] / K.diagonal()[:2]], dim=1)
    axes = then_to_world @ torch.linalg.inv(K_then)
    here, there = ([s.depth[item, 0], s.normal[item], s.mesh_id[item, 0]] for s in (Surfaces.of(frame), surfaces))
    matrices = [to_then, turn, slopes, axes.T, torch.tensor([PLANE_TOLERANCE, NORMAL_TOLERANCE])]
    return fetch(history[item], frame.motion[item], here, there, [matrix.numpy() for matrix in matrices])


def reproject(frame: Frame, history: Tensor, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
    """The previous frame's `history` (B, C, H, W) where this frame's surfaces find it, and where (B, 1, H, W).

    `surfaces` is the previous frame's G-buffer. The frame must have depth, normal, mesh_id and motion.
    """
    if compiled.usable(history, frame.motion, frame.depth, surfaces.depth):
        fetched = [fetch_compiled(frame, history, surfaces, item) for item in range(len(history))]
    else:
        fetched = [Reprojection(frame, history, surfaces, item).fetch() for item in range(len(history))]
    return torch.stack([value for value, _ in fetched]), torch.stack([found for _, found in fetched])


SMALLEST_ALPHA = 0.2


@dataclass(frozen=True)
class Accumulation:
    """History of accumulation: irradiance (B, 3, H, W), its length in frames (B, 1, H, W), and the G-buffer."""

    irradiance: Tensor
    length: Tensor
    surfaces: Surfaces


def accumulate(frame: Frame, irradiance: Tensor, history: Accumulation | None) -> Accumulation:
    """Blend noisy `irradiance` (B, 3, H, W) into its history with weight alpha = max(0.2, 1 / (n + 1)).

    n is the history's length, so the first five frames are averaged evenly; then it is an exponential moving average.
    Disoccluded pixels start anew.
    """
    irradiance = finite(irradiance)
    length = torch.ones_like(irradiance[:, :1])
    if history is not None:
        past, found = reproject(frame, torch.cat([history.irradiance, history.length], dim=1), history.surfaces)
        n = past[:, 3:]
        alpha = torch.where(found, (1 / (n + 1)).clamp(min=SMALLEST_ALPHA), 1)
        irradiance = torch.lerp(past[:, :3], irradiance, alpha)
        length = torch.where(found, n + 1, 1)
    return Accumulation(irradiance, length, Surfaces.of(frame))


SLOWEST_RATE = 0.1  # weight of the newest frame in running estimates, once they have settled
MEDIAN_GRID = 64  # the median depth of large images is taken from about as many rows and columns
LUMINANCE_BLOCK = 16  # px; the logarithm of a mean over a block is far less biased than that of single samples


@dataclass(frozen=True)
class RunningMean:
    """A causal mean over frames, (B,): even at first, then with weight 0.1 for the newest."""

    value: Tensor
    count: Tensor  # frames that contributed

    def update(self, new: Tensor, valid: Tensor) -> "RunningMean":
        """With one more frame's `new` (B,), where `valid` (B,)."""
        count = self.count + valid
        rate = (1 / count.clamp(min=1)).clamp(min=SLOWEST_RATE)
        return RunningMean(torch.where(valid, torch.lerp(self.value, new, rate), self.value), count)


@dataclass(frozen=True)
class RunningScale:
    """Causal estimates of a sequence's brightness and depth: what networks use instead of the clip's exposure."""

    log_luminance: RunningMean
    log_depth: RunningMean

    @staticmethod
    def neutral(like: Tensor) -> "RunningScale":
        """Exposure 1 and depth scale 1 for a batch of `like` (B, ...), until a frame tells better."""
        zero = like.new_zeros(len(like))
        return RunningScale(RunningMean(zero + math.log(0.18), zero), RunningMean(zero, zero))

    def exposure(self) -> Tensor:
        """0.18 / geometric mean luminance, (B, 1, 1, 1)."""
        return (0.18 * torch.exp(-self.log_luminance.value))[:, None, None, None]

    def normalised_depth(self, depth: Tensor) -> Tensor:
        """d / (d + s) in [0, 1) with s the running median depth; 1 for background (depth 0)."""
        scale = torch.exp(self.log_depth.value)[:, None, None, None]
        return torch.where(depth > 0, depth / (depth + scale), 1)


def running_scale(radiance: Tensor, depth: Tensor, before: RunningScale | None) -> RunningScale:
    """Update the estimates with one frame's noisy direct + indirect `radiance` (B, 3, H, W) and its `depth`.

    The logarithms of each frame's estimates are averaged. A frame that is all black, or has no surface, does not count.
    """
    before = before or RunningScale.neutral(radiance)
    luminances = luminance(finite(radiance)).clamp(min=0)
    blocks = F.avg_pool2d(luminances, LUMINANCE_BLOCK, ceil_mode=True, count_include_pad=False)
    y = blocks.flatten(1).double()
    mean = y.mean(dim=1)
    log_y = torch.log(torch.maximum(y, 1e-4 * mean[:, None]).clamp(min=1e-300)).mean(dim=1).to(radiance.dtype)
    stride_y, stride_x = (max(1, size // MEDIAN_GRID) for size in depth.shape[-2:])
    depths = depth[..., ::stride_y, ::stride_x].flatten(1)
    median = torch.where(depths > 0, depths, torch.nan).nanmedian(dim=1).values
    hit = ~median.isnan()
    log_depth = torch.log(torch.where(hit, median, 1))
    return RunningScale(before.log_luminance.update(log_y, mean > 0), before.log_depth.update(log_depth, hit))
