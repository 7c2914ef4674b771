"""Running exposure and depth scale (history/running_scale.py) in a graph: float32 alone, and any size of image."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from models.history.running_scale import LUMINANCE_BLOCK, MEDIAN_GRID, MIDDLE_GREY, MIN_RATE
from models.operators import image_luminance

LEAST_LUMINANCE = 1e-37  # normal in float32
# Zeros that fill up the last block of rows and columns, and one more, which tells tracers that there are two.
MARGIN = (0, 2 * LUMINANCE_BLOCK - 1, 0, 2 * LUMINANCE_BLOCK - 1)
LEAST_SHARE = LUMINANCE_BLOCK**-2 / 2  # of a block that shows a surface


class Scale(NamedTuple):
    """What the state says, each (1,)."""

    exposure: Tensor
    depth: Tensor  # the running median

    def normalised_depth(self, depth: Tensor) -> Tensor:
        """See models.history.running_scale.RunningScale.normalised_depth."""
        return torch.where(depth > 0, depth / (depth + self.depth), 1)


def measured_luminance(radiance: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """ln(luminance / middle grey) of the surfaces, averaged over blocks, and 1, or 0 where all is black: (1,) each."""
    surface = (depth > 0).to(depth)
    both = torch.cat([image_luminance(radiance).clamp(min=0) * surface, surface], dim=1)
    # What the margin takes away from the means cancels in their quotient.
    total, share = F.avg_pool2d(both, LUMINANCE_BLOCK).flatten(2).split(1, dim=1)  # (1, 1, blocks) each
    seen = (share > 0).to(total)
    y = total / share.clamp(min=LEAST_SHARE)
    blocks = seen.sum(dim=(0, 2)).clamp(min=1)
    mean = y.sum(dim=(0, 2)) / blocks
    log_y = torch.log(torch.maximum(y, 1e-4 * mean).clamp(min=LEAST_LUMINANCE) / MIDDLE_GREY) * seen
    return log_y.sum(dim=(0, 2)) / blocks, (mean > 0).to(y)


def measured_depth(depth: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """The logarithm of the median depth of some rows and columns, and 1, or 0 without any surface: (1,) each."""
    for dim, size in ((-2, height), (-1, width)):
        index = torch.arange(2 * MEDIAN_GRID) * torch.sym_max(1, size // MEDIAN_GRID)
        depth = depth.index_select(dim, index.clamp(max=size))  # indices beyond the last get the margin's background
    depths = depth.flatten()
    hits = (depths > 0).to(depths).sum(dim=0, keepdim=True)
    ascending = torch.where(depths > 0, depths, torch.inf).sort().values
    median = ascending.index_select(0, ((hits - 1) / 2).long())
    any_hit = (hits > 0).to(depths)
    return torch.log(torch.where(hits > 0, median, 1)), any_hit


def updated_scale(state: Tensor, radiance: Tensor, depth: Tensor) -> tuple[Tensor, Scale]:
    """The next `state`, and what it says: see models.history.running_scale.running_scale.

    The state (4,) are the running means of what is measured, and how many frames count in each; zeros at first.
    """
    padded = F.pad(depth, MARGIN)
    luminance = measured_luminance(F.pad(radiance, MARGIN), padded)
    new, valid = (torch.cat(both) for both in zip(luminance, measured_depth(padded, *depth.shape[-2:]), strict=True))
    mean, count = state.split(2)
    count = count + valid
    rate = (1 / count.clamp(min=1)).clamp(min=MIN_RATE) * valid
    mean = mean + rate * (new - mean)
    grey_over_luminance, depth_scale = torch.exp(mean * torch.tensor([-1.0, 1.0])).split(1)
    return torch.cat([mean, count]), Scale(grey_over_luminance, depth_scale)
