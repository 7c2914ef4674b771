"""Means over the cells of a bilateral grid, read out between cells: what NBGD filters with (Meng et al. 2020, §4)."""

from collections.abc import Iterator
from itertools import product

import torch
from torch import Tensor

from models import compiled
from models.compiled import bilateral_grid as kernels
from models.parameters import GUIDES, LEAST_WEIGHT


def cells_around(place: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
    """The cells before and after each place along an axis of `count` cells, and their weights.

    Places are counted in cells from the middle of the first one. Weights fall linearly to 0 over the width of a cell;
    those of cells outside the grid are 0.
    """
    first = place.detach().floor()
    cells = ((first, 1 - (place - first)), (first + 1, place - first))
    return [(cell.clamp(0, count - 1).long(), weight * (cell == cell.clamp(0, count - 1))) for cell, weight in cells]


def taps(guide: Tensor, spacing: int) -> tuple[int, Iterator[tuple[Tensor, Tensor]]]:
    """How many cells the grids of all items have; each pixel's eight, by their numbers (N,), with weights (N, 1)."""
    batch, _, height, width = guide.shape
    sizes = (batch, -(-height // spacing), -(-width // spacing), GUIDES // spacing)
    lines = (torch.arange(size).to(guide) + 0.5 for size in (height, width))
    y, x = (line / spacing - 0.5 for line in lines)
    z = ((GUIDES - 1) * guide[:, 0] + 0.5) / spacing - 0.5
    axes = (cells_around(y[:, None], sizes[1]), cells_around(x, sizes[2]), cells_around(z, sizes[3]))
    item = torch.arange(batch, device=guide.device)[:, None, None]

    def each() -> Iterator[tuple[Tensor, Tensor]]:
        for (row, by_row), (column, by_column), (level, by_level) in product(*axes):
            number = ((item * sizes[1] + row) * sizes[2] + column) * sizes[3] + level
            yield number.flatten(), (by_row * by_column * by_level).reshape(-1, 1)

    return sizes[0] * sizes[1] * sizes[2] * sizes[3], each()


@compiled.by(kernels.grid_mean)
def grid_mean(image: Tensor, guide: Tensor, spacing: int, surface: Tensor | None = None) -> Tensor:
    """Filter `image` (B, 3, H, W) through a bilateral grid. Differentiable in image and guide.

    A pixel lies at (x, y, 255 guide) in a space of H × W × 256, which cells of spacing³ divide. Each cell has the mean
    of the pixels around it, whose weights fall linearly along every axis, to 0 at a distance of a cell. A pixel gets
    what linear interpolation between the cells around it says; borders have no cells outside.

    Args:
        image: float32, finite.
        guide: (B, 1, H, W), in [0, 1].
        spacing: px, a power of two.
        surface: (B, 1, H, W), 1 for pixels that count; the others, with 0, become 0. By default all count.
    """
    counted = torch.ones_like(guide) if surface is None else surface
    values = torch.cat([image * counted, counted], dim=1).permute(0, 2, 3, 1).reshape(-1, 4)
    count, around = taps(guide, spacing)
    chosen = list(around)
    cells = values.new_zeros(count, 4)
    for cell, weight in chosen:
        cells.index_add_(0, cell, values * weight)
    # A pixel that counts is in all the cells that it reads: none of them is empty.
    means = cells[:, :3] / cells[:, 3:].clamp(min=LEAST_WEIGHT)
    total = torch.stack([weight * means[cell] for cell, weight in chosen]).sum(dim=0)
    share = torch.stack([weight for _, weight in chosen]).sum(dim=0)
    filtered = (total / share).reshape(len(image), *image.shape[-2:], 3).permute(0, 3, 1, 2)
    return filtered * counted
