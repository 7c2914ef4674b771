"""NBGD: the neural bilateral grid denoiser (Meng et al. 2020), for one sample a pixel.

A small network says for every pixel where it lies along the third axis of three bilateral grids, and how the three
pictures that are read out of these are to be mixed. Pixels are averaged in the cells of a grid, so only pixels of about
the same guide are, and the weights are learned through the grid. We do not have the whole of the paper's text: layers,
grids and weights are those of the code that its authors published (github.com/xmeng525/
RealTimeDenoisingNeuralBilateralGrid), which WSKP's authors compare with too: two convolutions of 5 x 5, 20 channels
between them, leaky ReLU; grids of 4, 8 and 16 pixels a cell and 64, 32 and 16 cells along the guide. The seven layers
with dense connections that the paper has for 64 samples a pixel are not here.

What is ours:

- Inputs and accumulation are those of WSKP, which its §6.1 gives NBGD too. The authors' are the same ten channels.
- Cells cover the whole of an image whose sides are no multiples of theirs.
- Background is in no cell. The authors read out what they call 0 as an empty cell, black ones too; here a cell is empty
  where no pixel has weight, and then nobody reads it.
- Tents are sharp; the authors round their tips by 10^-4 of a cell.
- The third weight, 1 - w_1 - w_2, may be below 0, so the mixture is no convex combination: what becomes negative is cut
  off.
- Weights begin as PyTorch's do.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from datasets.frame import Signal
from models.compiled.features import FEATURES
from models.networks.bilateral_grid import grid_mean
from models.networks.wskp import KernelPredictor

WIDTH = 20  # channels between the two layers
KERNEL = 5  # px
LEAK = 0.2  # slope of the leaky ReLU below 0
SPACINGS = (4, 8, 16)  # px, and values of a guide, from cell to cell


class NBGD(KernelPredictor):
    """Three guides and two weights a pixel; means over the cells of three bilateral grids, mixed."""

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        outputs = len(SPACINGS) + len(SPACINGS) - 1
        self.network = nn.Sequential(
            nn.Conv2d(sum(FEATURES.values()), WIDTH, KERNEL, padding=KERNEL // 2),
            nn.LeakyReLU(LEAK, inplace=True),
            nn.Conv2d(WIDTH, outputs, KERNEL, padding=KERNEL // 2),
        )
        # A pixel's cells begin up to two cells away.
        self.reach = 2 * (KERNEL // 2) + 2 * max(SPACINGS)

    def first_layers(self) -> Sequence[nn.Conv2d]:
        return [self.network[0]]  # type: ignore[index]

    def reconstruct(
        self, irradiance: Tensor, predicted: Tensor, surface: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        guides, shares = predicted.to(irradiance.dtype).sigmoid().split([len(SPACINGS), len(SPACINGS) - 1], dim=1)
        shares = torch.cat([shares, 1 - shares.sum(dim=1, keepdim=True)], dim=1)
        parts = [
            shares[:, [i]] * grid_mean(irradiance, guides[:, [i]], spacing, surface)
            for i, spacing in enumerate(SPACINGS)
        ]
        return torch.stack(parts).sum(dim=0).clamp(min=0), None
