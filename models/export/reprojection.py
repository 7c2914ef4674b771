"""Reprojection (history/reprojection.py) in a graph: taps are rows of one table that holds all they are tested on.

Pixels are in one dimension of n = H W.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.reprojection import NORMAL_TOLERANCE, PLANE_TOLERANCE
from models.history.geometry import BACKGROUND_ID

NOWHERE = -1.0  # mesh id around the image


class View(NamedTuple):
    """A frame's G-buffer (1, C, H, W) and its camera."""

    depth: Tensor
    normal: Tensor
    mesh_id: Tensor
    K: Tensor  # (3, 3)
    camera_to_world: Tensor  # (4, 4)

    def points(self, pixels: Tensor) -> Tensor:
        """What `pixels` (2, n) show, (3, n) in the camera's frame."""
        entries = self.K.flatten()
        focal = entries.index_select(0, torch.tensor([0, 4]))[:, None]
        middle = entries.index_select(0, torch.tensor([2, 5]))[:, None]
        along_axis = self.depth.view(1, -1)
        return torch.cat([(pixels + 0.5 - middle) / focal * along_axis, along_axis])

    def normals(self) -> Tensor:
        """Normals (3, n) in the camera's frame."""
        return self.camera_to_world[:3, :3].T @ self.normal.view(3, -1)


def places(height: int, width: int) -> Tensor:
    """Columns and rows (2, n) of all pixels."""
    columns = torch.arange(width, dtype=torch.float32).expand(height, width)
    rows = torch.arange(height, dtype=torch.float32)[:, None].expand(height, width)
    return torch.stack([columns, rows]).flatten(1)


def table_of(history: Tensor, then: View, pixels: Tensor) -> Tensor:
    """Rows ((H + 2) (W + 2), 6 + C) of the previous frame's pixels and a border: what `taps` tests, and the history.

    That is the normal n in the camera's frame, n · p of the point p, how far off its plane one may be, the mesh id.
    """
    height, width = then.depth.shape[-2:]
    normals = then.normals()
    offset = (normals * then.points(pixels)).sum(dim=0).view(1, 1, height, width)
    tested = [normals.view(1, 3, height, width), offset, PLANE_TOLERANCE * then.depth, then.mesh_id.to(offset)]
    images = F.pad(torch.cat([*tested, history], dim=1), (1, 1, 1, 1), value=NOWHERE)
    return images[0].flatten(1).T.contiguous()


def expectation(now: View, to_previous: Tensor, pixels: Tensor) -> Tensor:
    """Where the previous camera must have seen what pixels show, (7, n): point, normal, mesh id."""
    mesh = now.mesh_id.view(1, -1)
    matrices = to_previous[:, :3].flatten(1).index_select(0, mesh[0]).T.unflatten(0, (3, 4))
    turn, shift = matrices.split([3, 1], dim=1)
    point = (turn * now.points(pixels)).sum(dim=1) + shift[:, 0]
    normals = (turn * now.normals()).sum(dim=1)
    return torch.cat([point, normals, mesh.to(point)])


def taps(table: Tensor, expected: Tensor, at: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """History (C, K, n) at columns and rows `at` (2, K, n) for pixels of which (7, n) is expected.

    The second are 1 where a tap is consistent, else 0, (K, n).
    """
    column, row = at.unbind()
    index = (row.clamp(-1, height) + 1) * (width + 2) + column.clamp(-1, width) + 1
    found = table.index_select(0, index.flatten()).T.unflatten(1, (len(index), -1))
    normal, offset, tolerance, mesh, history = found.split([3, 1, 1, 1, found.shape[0] - 6])
    point, expected_normal, expected_mesh = expected[:, None].split([3, 3, 1])
    off_plane = ((normal * point).sum(dim=0, keepdim=True) - offset).abs()
    cosine = (normal * expected_normal).sum(dim=0, keepdim=True)
    same_surface = (expected_mesh == BACKGROUND_ID) | (off_plane <= tolerance) & (cosine >= NORMAL_TOLERANCE)
    return history, ((mesh == expected_mesh) & same_surface)[0].to(history)


def fetch(table: Tensor, expected: Tensor, motion: Tensor, pixels: Tensor) -> Tensor:
    """The history (1, C, H, W) of all pixels, 0 where none was found. `motion` is (1, 2, H, W).

    2 x 2 taps for every pixel, 3 x 3 for those that found none there.
    """
    height, width = motion.shape[-2:]
    # Far outside the image an index would overflow; any place outside is as good.
    position = (pixels + motion.view(2, -1)).clamp(-2, torch.sym_max(height, width) + 1)
    floor = position.floor()
    fraction = position - floor
    corners = torch.tensor([[0, 1, 0, 1], [0, 0, 1, 1]])[:, :, None]
    weight = (1 - corners - fraction[:, None]).abs().prod(dim=0)  # f where a corner is 1, 1 - f where it is 0
    history, consistent = taps(table, expected, floor.long()[:, None] + corners, height, width)
    count = consistent.sum(dim=0)
    failed = (weight * (1 - consistent)).sum(dim=0)
    history = (history * ((weight + failed / count.clamp(min=1)) * consistent)).sum(dim=1)

    lost = torch.nonzero(count == 0)[:, 0]
    around = torch.tensor([[-1, 0, 1] * 3, [-1] * 3 + [0] * 3 + [1] * 3])[:, :, None]
    middle = (position.index_select(1, lost) + 0.5).floor().long()
    nearby, consistent = taps(table, expected.index_select(1, lost), middle[:, None] + around, height, width)
    mean = (nearby * consistent).sum(dim=1) / consistent.sum(dim=0).clamp(min=1)
    history = history.scatter(1, lost.expand(len(history), -1), mean)
    return history.view(1, -1, height, width)
