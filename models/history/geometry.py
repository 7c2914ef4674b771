"""G-buffers, and the camera geometry that leads from a pixel to its place in the previous frame."""

from dataclasses import dataclass

import torch
from torch import Tensor

from datasets.cameras import Cameras
from datasets.frame import Frame

BACKGROUND_ID = 0  # mesh id of pixels that show no surface


@dataclass(frozen=True)
class GBuffer:
    """The part of a frame's G-buffer that reprojection tests taps against."""

    depth: Tensor  # (B, 1, H, W)
    normal: Tensor  # (B, 3, H, W), world space
    mesh_id: Tensor  # (B, 1, H, W)

    @staticmethod
    def of(frame: Frame) -> "GBuffer":
        return GBuffer(frame.depth, frame.normal, frame.mesh_id)


def pixel_centres(height: int, width: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """x and y of the centres of all pixels, (H, W) each, of the type and on the device of `like`."""
    y, x = torch.meshgrid(torch.arange(height).to(like) + 0.5, torch.arange(width).to(like) + 0.5, indexing="ij")
    return x, y


def rays(K: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Directions (..., 3) in the camera frame, of unit length along the viewing axis, through pixels at x, y (...)."""
    K = K.to(x)
    return torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(x)], dim=-1)


def frame_rays(frame: Frame) -> Tensor:
    """`rays` through all pixels of a frame, (B, H, W, 3)."""
    x, y = pixel_centres(*frame.size, frame.depth)
    return torch.stack([rays(K, x, y) for K in frame.now.K])


def ray_axes(cameras: Cameras) -> Tensor:
    """Matrices (B, 3, 3) from (x, y, 1) in pixels to the world-space direction of that ray, up to depth 1."""
    return cameras.camera_to_world[:, :3, :3] @ torch.linalg.inv(cameras.K)


def positions_around_eye(depth: Tensor, axes: Tensor) -> Tensor:
    """Positions of surfaces relative to the camera, in world axes: (B, 3, H, W), float64, from its `ray_axes`."""
    height, width = depth.shape[-2:]
    x, y = pixel_centres(height, width, axes)
    return torch.einsum("bij,jhw->bihw", axes, torch.stack([x, y, torch.ones_like(x)])) * depth


def inverse_pose(matrix: Tensor) -> Tensor:
    """Inverse of rigid transforms (..., 4, 4)."""
    inverse = torch.zeros_like(matrix)
    inverse[..., :3, :3] = matrix[..., :3, :3].mT
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ matrix[..., :3, 3:]
    inverse[..., 3, 3] = 1
    return inverse


def to_previous_camera(now: Cameras, previous: Cameras, item: int) -> Tensor:
    """Transforms (M + 1, 4, 4) by mesh id: from this frame's camera to the previous one's, moving with the mesh.

    Products are taken in float64 and camera to camera, so that scenes far from the origin keep their precision.
    """
    moved = previous.object_to_world[item] @ inverse_pose(now.object_to_world[item])
    still = torch.eye(4).to(moved)[None]
    return inverse_pose(previous.camera_to_world[item]) @ torch.cat([still, moved]) @ now.camera_to_world[item]
