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

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from datasets.frame import Signal
from models.compiled.features import FEATURE_CHANNELS
from models.networks.bilateral_grid import grid_mean
from models.networks.wskp import Filtered, KernelPredictor

NBGD_WIDTH = 20  # channels between the two layers
KERNEL = 5  # px
LEAK = 0.2  # slope of the leaky ReLU below 0
SPACINGS = (4, 8, 16)  # px, and values of a guide, from cell to cell


class NBGD(KernelPredictor):
    """Three guides and two mixing weights per pixel; means over the cells of three bilateral grids, mixed."""

    made_from = "code"

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

    def first_layers(self) -> Sequence[nn.Conv2d]:
        return [self.network[0]]  # type: ignore[index]

    def reconstruct(self, irradiance: Tensor, predicted: Tensor, surface: Tensor | None = None) -> Filtered:
        guides, shares = predicted.to(irradiance.dtype).sigmoid().split([len(SPACINGS), len(SPACINGS) - 1], dim=1)
        shares = torch.cat([shares, 1 - shares.sum(dim=1, keepdim=True)], dim=1)
        means = (grid_mean(irradiance, guides[:, [i]], spacing, surface) for i, spacing in enumerate(SPACINGS))
        parts = [share * mean for share, mean in zip(shares.split(1, dim=1), means, strict=True)]
        return torch.stack(parts).sum(dim=0).clamp(min=0), None
