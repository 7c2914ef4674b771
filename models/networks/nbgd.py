"""NBGD: the neural bilateral grid denoiser (Meng et al. 2020), for one sample a pixel.

A small network predicts each pixel's position along the third axis of three bilateral grids (its guides) and how to mix
the three images read from these grids. The paper's full text was not available: layers, grids and mixing weights follow
the authors' code (github.com/xmeng525/RealTimeDenoisingNeuralBilateralGrid): two 5 x 5 convolutions with 20 channels
between them and leaky ReLU; grids of 4, 8 and 16 pixels per cell and 64, 32 and 16 cells along the guide. The paper's
seven-layer network for 64 spp is not implemented.

What differs:

- Inputs and accumulation are those of WSKP, as in its §6.1; the ten channels are the authors'.
- Cells cover images whose sides are no multiples of theirs; background is in no cell.
- Tents are sharp; the authors round their tips by 10^-4 of a cell.
- The third weight, 1 - w_1 - w_2, may be below 0: negative results are clamped to 0.
- Weights have PyTorch's default initialisation.
"""

import math
from itertools import product

import torch
from torch import Tensor, nn

from datasets.frame import Signal
from models import compiled
from models.compiled import bilateral_grid as kernels
from models.compiled.bilateral_grid import GUIDES
from models.compiled.features import FEATURE_CHANNELS
from models.networks.wskp import Filtered, KernelPredictor
from models.operators import MIN_DIVISOR

NBGD_WIDTH = 20  # channels between the two layers
KERNEL = 5  # px
LEAK = 0.2  # slope of the leaky ReLU below 0
SPACINGS = (4, 8, 16)  # px, and values of a guide, from cell to cell


def cells_around(place: Tensor, count: int) -> list[tuple[Tensor, Tensor]]:
    """The cells before and after each place along an axis of `count` cells, and their weights.

    Places are counted in cells from the middle of the first one. Weights fall linearly to 0 over the width of a cell;
    those of cells outside the grid are 0.
    """
    first = place.detach().floor()
    cells = ((first, 1 - (place - first)), (first + 1, place - first))
    return [(cell.clamp(0, count - 1).long(), weight * (cell == cell.clamp(0, count - 1))) for cell, weight in cells]


def grid_shape(guide: Tensor, spacing: int) -> tuple[int, int, int, int]:
    """Items, and cells down, across and along the guide (B, 1, H, W)."""
    batch, _, height, width = guide.shape
    return batch, -(-height // spacing), -(-width // spacing), GUIDES // spacing


def cells_of_pixels(guide: Tensor, spacing: int) -> list[tuple[Tensor, Tensor]]:
    """The eight cells around each pixel: their numbers (N,), row after row of all items, and weights (N, 1)."""
    batch, down, across, along = grid_shape(guide, spacing)
    y, x = ((torch.arange(size).to(guide) + 0.5) / spacing - 0.5 for size in guide.shape[-2:])
    z = ((GUIDES - 1) * guide[:, 0] + 0.5) / spacing - 0.5
    item = torch.arange(batch, device=guide.device)[:, None, None]
    weighted = []
    axes = (cells_around(y[:, None], down), cells_around(x, across), cells_around(z, along))
    for (row, by_row), (column, by_column), (level, by_level) in product(*axes):
        cell = ((item * down + row) * across + column) * along + level
        weighted.append((cell.flatten(), (by_row * by_column * by_level).reshape(-1, 1)))
    return weighted


@compiled.by(kernels.grid_mean)
def grid_mean(image: Tensor, guide: Tensor, spacing: int, surface: Tensor | None = None) -> Tensor:
    """Filter `image` (B, 3, H, W) through a bilateral grid. Differentiable in image and guide.

    A pixel lies at (x, y, 255 guide) in a space of H × W × 256, which cells of spacing³ divide. Each cell has the mean
    of the pixels around it, whose weights fall linearly along every axis, to 0 at a distance of a cell. A pixel is
    interpolated linearly between the cells around it; there are no cells outside the image.

    The image is finite, the guide (B, 1, H, W) in [0, 1], the spacing a power of two, in px. Pixels off the `surface`
    (B, 1, H, W) do not count and become 0; by default all count.
    """
    counted = torch.ones_like(guide) if surface is None else surface
    values = torch.cat([image * counted, counted], dim=1).permute(0, 2, 3, 1).reshape(-1, 4)
    corners = cells_of_pixels(guide, spacing)
    cells = values.new_zeros(math.prod(grid_shape(guide, spacing)), 4)
    for cell, weight in corners:
        cells.index_add_(0, cell, values * weight)
    # A pixel that counts is in all the cells that it reads: none of them is empty.
    means = cells[:, :3] / cells[:, 3:].clamp(min=MIN_DIVISOR)
    total = torch.stack([weight * means[cell] for cell, weight in corners]).sum(dim=0)
    share = torch.stack([weight for _, weight in corners]).sum(dim=0)
    filtered = (total / share).reshape(len(image), *image.shape[-2:], 3).permute(0, 3, 1, 2)
    return filtered * counted


class NBGD(KernelPredictor):
    """Three guides and two mixing weights per pixel; means over the cells of three bilateral grids, mixed."""

    made_from = "code"
    first_layer = "network.0"

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        outputs = 2 * len(SPACINGS) - 1
        self.network = nn.Sequential(
            nn.Conv2d(sum(FEATURE_CHANNELS.values()), NBGD_WIDTH, KERNEL, padding=KERNEL // 2),
            nn.LeakyReLU(LEAK, inplace=True),
            nn.Conv2d(NBGD_WIDTH, outputs, KERNEL, padding=KERNEL // 2),
        )
        # A pixel's cells reach up to two cells away.
        self.reach = 2 * (KERNEL // 2) + 2 * max(SPACINGS)

    def reconstruct(self, irradiance: Tensor, predicted: Tensor, surface: Tensor | None = None) -> Filtered:
        guides, shares = predicted.to(irradiance.dtype).sigmoid().split([len(SPACINGS), len(SPACINGS) - 1], dim=1)
        shares = torch.cat([shares, 1 - shares.sum(dim=1, keepdim=True)], dim=1)
        means = (grid_mean(irradiance, guides[:, [i]], spacing, surface) for i, spacing in enumerate(SPACINGS))
        parts = [share * mean for share, mean in zip(shares.split(1, dim=1), means, strict=True)]
        return torch.stack(parts).sum(dim=0).clamp(min=0), None
