"""Reprojection and running scale (models/history) in a graph, for images of any size.

Taps of the reprojection are rows of one table, which contains all that validation compares. Pixels are in one dimension
of n = H W.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.reprojection import HISTORY_PLANE_TOLERANCE, NORMAL_TOLERANCE
from models.history.geometry import BACKGROUND_ID
from models.history.running_scale import LUMINANCE_BLOCK, MEDIAN_GRID, MIDDLE_GREY, MIN_RATE
from models.operators import image_luminance

OUTSIDE_ID = -1.0  # mesh id around the image
MIN_LUMINANCE = 1e-37  # normal in float32
MIN_BLOCK_SHARE = LUMINANCE_BLOCK**-2 / 2  # of a block that shows a surface


class GraphGBuffer(NamedTuple):
    """A frame's surfaces (1, C, H, W) and its camera."""

    depth: Tensor
    normal: Tensor
    mesh_id: Tensor
    K: Tensor  # (3, 3)
    camera_to_world: Tensor  # (4, 4)

    def points(self, pixels: Tensor) -> Tensor:
        """Visible points (3, n) of `pixels` (2, n), in camera space."""
        focal, middle = self.K.flatten().index_select(0, torch.tensor([0, 4, 2, 5]))[:, None].split(2)
        along_axis = self.depth.view(1, -1)
        return torch.cat([(pixels + 0.5 - middle) / focal * along_axis, along_axis])

    def normals(self) -> Tensor:
        """Normals (3, n) in camera space."""
        return self.camera_to_world[:3, :3].T @ self.normal.view(3, -1)


def reprojection_table(history: Tensor, previous: GraphGBuffer, pixels: Tensor) -> Tensor:
    """Rows ((H + 2) (W + 2), 6 + C) of the previous frame's pixels and a border, for `taps`.

    A row: normal n in camera space, n · p of the point p, tolerated distance from its plane, mesh id, history.
    """
    height, width = previous.depth.shape[-2:]
    normals = previous.normals()
    offset = (normals * previous.points(pixels)).sum(dim=0).view(1, 1, height, width)
    tolerance = HISTORY_PLANE_TOLERANCE * previous.depth
    parts = [normals.view(1, 3, height, width), offset, tolerance, previous.mesh_id.to(offset), history]
    images = F.pad(torch.cat(parts, dim=1), (1, 1, 1, 1), value=OUTSIDE_ID)
    return images[0].flatten(1).T.contiguous()


def expected_surfaces(now: GraphGBuffer, to_previous: Tensor, pixels: Tensor) -> Tensor:
    """This frame's surfaces in the previous frame's camera space, (7, n): point, normal, mesh id."""
    mesh = now.mesh_id.view(1, -1)
    matrices = to_previous[:, :3].flatten(1).index_select(0, mesh[0]).T.unflatten(0, (3, 4))
    rotation, translation = matrices.split([3, 1], dim=1)
    point = (rotation * now.points(pixels)).sum(dim=1) + translation[:, 0]
    normals = (rotation * now.normals()).sum(dim=1)
    return torch.cat([point, normals, mesh.to(point)])


def taps(table: Tensor, expected: Tensor, at: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """History (C, K, n) at columns and rows `at` (2, K, n), and 1 where the tap shows the `expected` (7, n), else 0."""
    column, row = at.unbind()
    index = (row.clamp(-1, height) + 1) * (width + 2) + column.clamp(-1, width) + 1
    rows = table.index_select(0, index.flatten()).T.unflatten(1, (len(index), -1))
    normal, offset, tolerance, mesh, history = rows.split([3, 1, 1, 1, rows.shape[0] - 6])
    point, expected_normal, expected_mesh = expected[:, None].split([3, 3, 1])
    off_plane = ((normal * point).sum(dim=0, keepdim=True) - offset).abs()
    cosine = (normal * expected_normal).sum(dim=0, keepdim=True)
    same_surface = (expected_mesh == BACKGROUND_ID) | (off_plane <= tolerance) & (cosine >= NORMAL_TOLERANCE)
    return history, ((mesh == expected_mesh) & same_surface)[0].to(history)


def reprojected(
    history: Tensor, now: GraphGBuffer, previous: GraphGBuffer, to_previous: Tensor, motion: Tensor
) -> Tensor:
    """The history (1, C, H, W) at all pixels, 0 where no tap is valid. `motion` is (1, 2, H, W).

    2 x 2 taps for every pixel, 3 x 3 for those without a valid one.
    """
    height, width = motion.shape[-2:]
    columns = torch.arange(width, dtype=torch.float32).expand(height, width)
    rows = torch.arange(height, dtype=torch.float32)[:, None].expand(height, width)
    pixels = torch.stack([columns, rows]).flatten(1)
    table = reprojection_table(history, previous, pixels)
    expected = expected_surfaces(now, to_previous, pixels)
    # Far outside the image an index would overflow; any position outside is as good.
    position = (pixels + motion.view(2, -1)).clamp(-2, torch.sym_max(height, width) + 1)
    floor = position.floor()
    fraction = position - floor
    corners = torch.tensor([[0, 1, 0, 1], [0, 0, 1, 1]])[:, :, None]
    weight = (1 - corners - fraction[:, None]).abs().prod(dim=0)  # f where a corner is 1, 1 - f where it is 0
    history, valid = taps(table, expected, floor.long()[:, None] + corners, height, width)
    count = valid.sum(dim=0)
    failed = (weight * (1 - valid)).sum(dim=0)
    history = (history * ((weight + failed / count.clamp(min=1)) * valid)).sum(dim=1)

    lost = torch.nonzero(count == 0)[:, 0]
    offsets = torch.tensor([[-1, 0, 1] * 3, [-1] * 3 + [0] * 3 + [1] * 3])[:, :, None]
    nearest = (position.index_select(1, lost) + 0.5).floor().long()
    nearby, valid = taps(table, expected.index_select(1, lost), nearest[:, None] + offsets, height, width)
    mean = (nearby * valid).sum(dim=1) / valid.sum(dim=0).clamp(min=1)
    history = history.scatter(1, lost.expand(len(history), -1), mean)
    return history.view(1, -1, height, width)


def in_whole_blocks(image: Tensor, block: int) -> Tensor:
    """With zeros that fill up the last block of rows and columns, and one more: tracers need to see two."""
    padding = 2 * block - 1
    return F.pad(image, (0, padding, 0, padding))


def measured_luminance(radiance: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """ln(luminance / middle grey) of the surfaces, averaged over blocks, and 1, or 0 where all is black: (1,) each."""
    surface = (depth > 0).to(depth)
    both = torch.cat([image_luminance(radiance).clamp(min=0) * surface, surface], dim=1)
    # The padding lowers both means alike: their quotient is that of the image.
    total, share = F.avg_pool2d(both, LUMINANCE_BLOCK).flatten(2).split(1, dim=1)  # (1, 1, blocks) each
    has_surface = (share > 0).to(total)
    y = total / share.clamp(min=MIN_BLOCK_SHARE)
    blocks = has_surface.sum(dim=(0, 2)).clamp(min=1)
    mean = y.sum(dim=(0, 2)) / blocks
    log_y = torch.log(torch.maximum(y, 1e-4 * mean).clamp(min=MIN_LUMINANCE) / MIDDLE_GREY) * has_surface
    return log_y.sum(dim=(0, 2)) / blocks, (mean > 0).to(y)


def measured_depth(depth: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """ln of the median depth over some rows and columns, and 1, or 0 without any surface: (1,) each."""
    for dim, size in ((-2, height), (-1, width)):
        index = torch.arange(2 * MEDIAN_GRID) * torch.sym_max(1, size // MEDIAN_GRID)
        depth = depth.index_select(dim, index.clamp(max=size))  # indices beyond the last get the padding's background
    depths = depth.flatten()
    hits = (depths > 0).to(depths).sum(dim=0, keepdim=True)
    ascending = torch.where(depths > 0, depths, torch.inf).sort().values
    median = ascending.index_select(0, ((hits - 1) / 2).long())
    any_hit = (hits > 0).to(depths)
    return torch.log(torch.where(hits > 0, median, 1)), any_hit


def updated_scale(state: Tensor, radiance: Tensor, depth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The next `state`, the exposure (1,) and the normalised depth: see models.history.running_scale.

    The state (4,) contains the running means of both measurements and their frame counts; zeros at first.
    """
    padded = in_whole_blocks(depth, LUMINANCE_BLOCK)
    luminance = measured_luminance(in_whole_blocks(radiance, LUMINANCE_BLOCK), padded)
    new, valid = (torch.cat(both) for both in zip(luminance, measured_depth(padded, *depth.shape[-2:]), strict=True))
    mean, count = state.split(2)
    count = count + valid
    rate = (1 / count.clamp(min=1)).clamp(min=MIN_RATE) * valid
    mean = mean + rate * (new - mean)
    exposure, depth_scale = torch.exp(mean * torch.tensor([-1.0, 1.0])).split(1)
    return torch.cat([mean, count]), exposure, torch.where(depth > 0, depth / (depth + depth_scale), 1)
