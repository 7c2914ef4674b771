"""Reprojection: where each pixel's surface was in the previous frame, and what an image held there (SVGF §4.1)."""

from typing import Any, cast

import torch
from torch import Tensor

from datasets.frame import Frame
from models import compiled
from models.compiled import reprojection as kernels
from models.compiled.reprojection import HISTORY_PLANE_TOLERANCE, NORMAL_TOLERANCE
from models.history.geometry import BACKGROUND_ID, GBuffer, pixel_centres, rays, to_previous_camera


class Reprojection:
    """Fetches the history of every pixel of one batch item along its motion vector (SVGF §4.1).

    A bilinear filter of 2 x 2 taps, each validated by depth, normal and mesh id; the weights of failed taps are spread
    evenly over the valid ones. Where all fail, a 3 x 3 box is tried; where that fails too, the pixel is disoccluded.
    """

    def __init__(self, frame: Frame, image: Tensor, gbuffer: GBuffer, item: int):
        self.height, self.width = frame.size
        self.image = image[item].flatten(1)  # (C, H W)
        self.gbuffer = torch.cat([gbuffer.depth[item], gbuffer.normal[item], gbuffer.mesh_id[item]]).flatten(1)
        self.previous_K = frame.previous.K[item]
        self.mesh = frame.mesh_id[item, 0].flatten()  # (H W,)
        motion = frame.motion[item]
        x, y = pixel_centres(self.height, self.width, motion)
        self.position = torch.stack([x + motion[0], y + motion[1]]).flatten(1)  # (2, H W), in the previous frame

        # The expected position of each surface point and its normal, in the previous camera's frame.
        matrices = to_previous_camera(frame.now, frame.previous, item).to(motion)
        has_matrix = (self.mesh >= 0) & (self.mesh < len(matrices))  # meshes without a pose stand still, as background
        matrix = matrices[torch.where(has_matrix, self.mesh, BACKGROUND_ID).long()]
        point = frame.depth[item].flatten()[:, None] * rays(frame.now.K[item], x.flatten(), y.flatten())
        to_camera = frame.now.camera_to_world[item, :3, :3].T.to(motion)
        self.point = torch.einsum("nij,nj->ni", matrix[:, :3, :3], point) + matrix[:, :3, 3]  # (H W, 3)
        self.normal = torch.einsum("nij,jk,kn->ni", matrix[:, :3, :3], to_camera, frame.normal[item].flatten(1))
        self.world_to_previous = frame.previous.camera_to_world[item, :3, :3].T.to(motion)

    def taps(self, pixels: Tensor, corner: Tensor, offsets: range) -> tuple[Tensor, Tensor]:
        """The image (C, K, n) at K taps for the n `pixels` (indices), and whether each tap is valid (K, n).

        The taps lie at `offsets` from the pixel `corner` (2, n) along both axes, row by row.
        """
        offset = torch.tensor(offsets, device=corner.device)
        dy, dx = torch.cartesian_prod(offset, offset).T
        column = corner[0] + dx[:, None]
        row = corner[1] + dy[:, None]
        inside = (column >= 0) & (column < self.width) & (row >= 0) & (row < self.height)
        index = row.clamp(0, self.height - 1) * self.width + column.clamp(0, self.width - 1)
        depth = self.gbuffer[0, index]
        normal = torch.einsum("ij,jkn->kni", self.world_to_previous, self.gbuffer[1:4, index])
        same_mesh = self.gbuffer[4, index] == self.mesh[pixels]
        position = depth[..., None] * rays(self.previous_K, column + 0.5, row + 0.5)
        off_plane = ((self.point[pixels] - position) * normal).sum(dim=-1).abs()
        same_plane = off_plane <= HISTORY_PLANE_TOLERANCE * depth
        same_normal = (normal * self.normal[pixels]).sum(dim=-1) >= NORMAL_TOLERANCE
        background = self.mesh[pixels] == BACKGROUND_ID
        return self.image[:, index], inside & same_mesh & (background | same_plane & same_normal)

    def bilinear(self) -> tuple[Tensor, Tensor]:
        """History (C, H W) and where there is one (H W,)."""
        # Far outside the image an index would overflow; any place outside is as good.
        x = (self.position[0] - 0.5).clamp(-2, self.width + 1)
        y = (self.position[1] - 0.5).clamp(-2, self.height + 1)
        corner = torch.stack([x, y]).floor()
        fx = x - corner[0]
        fy = y - corner[1]
        weight = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
        image, valid = self.taps(torch.arange(x.numel(), device=x.device), corner.long(), range(2))
        count = valid.sum(dim=0)
        failed = (weight * ~valid).sum(dim=0)
        weight = torch.where(valid, weight + failed / count.clamp(min=1), 0)
        return (image * weight).sum(dim=1), count > 0

    def box(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """History (C, n) of the n `pixels` from 3 x 3 taps, and where there is one (n,)."""
        centre = self.position[:, pixels].clamp(-2, max(self.height, self.width) + 1).floor().long()
        image, valid = self.taps(pixels, centre, range(-1, 2))
        count = valid.sum(dim=0)
        return (image * valid).sum(dim=1) / count.clamp(min=1), count > 0

    def fetch(self) -> tuple[Tensor, Tensor]:
        """History (C, H, W), 0 where there is none, and where there is one (1, H, W)."""
        history, has_history = self.bilinear()
        failed = torch.nonzero(~has_history).flatten()
        if len(failed):
            history[:, failed], has_history[failed] = self.box(failed)
        size = self.height, self.width
        return (history * has_history).view(-1, *size), has_history.view(1, *size)


class CompiledReprojection(torch.autograd.Function):
    """Forward and backward by kernels for the CPU."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, frame: Frame, gbuffer: GBuffer) -> tuple[Tensor, Tensor]:
        history, has_history = kernels.reproject(frame, image, gbuffer)
        ctx.frame = frame
        ctx.gbuffer = gbuffer
        ctx.mark_non_differentiable(has_history)
        return history, has_history

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        return kernels.reproject_back(gradients[0], ctx.frame, ctx.gbuffer), None, None


def reproject(frame: Frame, image: Tensor, gbuffer: GBuffer) -> tuple[Tensor, Tensor]:
    """The history (B, C, H, W) of a frame's pixels, 0 where they have none, and where they have one (B, 1, H, W).

    `image` (B, C, H, W) and `gbuffer` are the previous frame's. The frame needs depth, normal, mesh_id and motion.
    """
    if compiled.usable(image):
        return cast(tuple[Tensor, Tensor], CompiledReprojection.apply(image, frame, gbuffer))
    fetched = [Reprojection(frame, image, gbuffer, item).fetch() for item in range(len(image))]
    return torch.stack([history for history, _ in fetched]), torch.stack([valid for _, valid in fetched])
