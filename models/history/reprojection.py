"""Where this frame's surfaces were in the previous frame, and what its images held there (SVGF §4.1)."""

from typing import Any

import torch
from torch import Tensor

from datasets.frame import Frame
from models import compiled
from models.compiled import reprojection as kernels
from models.compiled.reprojection import NORMAL_TOLERANCE, PLANE_TOLERANCE
from models.history.surfaces import BACKGROUND_ID, Surfaces, rays, to_previous_camera


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
        self.mesh = frame.mesh_id[item, 0].long().flatten()  # (H W,)
        motion = frame.motion[item]
        y, x = torch.meshgrid(
            torch.arange(self.height, device=motion.device) + 0.5,
            torch.arange(self.width, device=motion.device) + 0.5,
            indexing="ij",
        )
        self.position = torch.stack([x + motion[0], y + motion[1]]).flatten(1)  # (2, H W), in the previous frame

        # Where each surface point and its normal are expected, in the previous camera's frame.
        depth = frame.depth[item, 0].flatten()
        normal = frame.normal[item].flatten(1)
        matrix = to_previous_camera(frame.now, frame.previous, item).to(motion)[self.mesh]
        ray = rays(frame.now.K[item], x.flatten(), y.flatten())
        world_to_camera = frame.now.camera_to_world[item, :3, :3].T.to(motion)
        self.point = torch.einsum("nij,nj->ni", matrix[:, :3, :3], depth[:, None] * ray) + matrix[:, :3, 3]  # (H W, 3)
        self.normal = torch.einsum("nij,jk,kn->ni", matrix[:, :3, :3], world_to_camera, normal)  # (H W, 3)
        self.world_to_previous = frame.previous.camera_to_world[item, :3, :3].T.to(motion)

    def taps(self, pixels: Tensor, column: Tensor, row: Tensor) -> tuple[Tensor, Tensor]:
        """History (C, K, n) at taps (K, n) for the n `pixels` (indices), and whether each tap is consistent (K, n)."""
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        index = row.clamp(0, self.height - 1) * self.width + column.clamp(0, self.width - 1)
        depth = self.then[0, index]
        normal = torch.einsum("ij,jkn->kni", self.world_to_previous, self.then[1:4, index])
        mesh = self.then[4, index]
        seen = depth[..., None] * rays(self.previous_K, column + 0.5, row + 0.5)
        expected = self.point[pixels]
        off_plane = ((expected - seen) * normal).sum(dim=-1).abs()
        same_plane = off_plane <= PLANE_TOLERANCE * depth
        same_normal = (normal * self.normal[pixels]).sum(dim=-1) >= NORMAL_TOLERANCE
        background = self.mesh[pixels] == BACKGROUND_ID
        return self.history[:, index], inside & (mesh == self.mesh[pixels]) & (background | same_plane & same_normal)

    def bilinear(self) -> tuple[Tensor, Tensor]:
        """History (C, H W) and whether it was found (H W,)."""
        # Far outside the image an index would overflow; any place outside is as good.
        x = (self.position[0] - 0.5).clamp(-2, self.width + 1)
        y = (self.position[1] - 0.5).clamp(-2, self.height + 1)
        left = x.floor()
        top = y.floor()
        fx = x - left
        fy = y - top
        shift = torch.tensor([[0, 1, 0, 1], [0, 0, 1, 1]], device=x.device)
        weight = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
        everything = torch.arange(x.numel(), device=x.device)
        column = left.long() + shift[0][:, None]
        row = top.long() + shift[1][:, None]
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
        column = centre[0] + shift_x.flatten()[:, None]
        row = centre[1] + shift_y.flatten()[:, None]
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


class CompiledReprojection(torch.autograd.Function):
    """Both directions by kernels for the processor."""

    @staticmethod
    def forward(ctx: Any, history: Tensor, frame: Frame, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
        fetched, found = kernels.reproject(frame, history, surfaces)
        ctx.frame = frame
        ctx.surfaces = surfaces
        ctx.mark_non_differentiable(found)
        return fetched, found

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        return kernels.reproject_back(gradients[0], ctx.frame, ctx.surfaces), None, None


def reproject(frame: Frame, history: Tensor, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
    """The previous frame's `history` (B, C, H, W) where this frame's surfaces find it, and where (B, 1, H, W).

    `surfaces` is the previous frame's G-buffer. The frame must have depth, normal, mesh_id and motion. The history is 0
    where none is found.
    """
    if compiled.with_gradients(history):
        result: tuple[Tensor, Tensor] = CompiledReprojection.apply(history, frame, surfaces)
        return result
    fetched = [Reprojection(frame, history, surfaces, item).fetch() for item in range(len(history))]
    return torch.stack([value for value, _ in fetched]), torch.stack([found for _, found in fetched])
