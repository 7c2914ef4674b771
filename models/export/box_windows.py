"""Weight-shared kernels (networks/fusion.py) in few operators: the box sums of all windows are two convolutions."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from models.compiled.exponential import MIN_EXPONENT
from models.compiled.fusion import OUTSIDE_LOGIT, SAFE_RANGE
from models.operators import MIN_DIVISOR

SUMMED = 4  # channels of each window's sums: weighted red, green and blue, and the weights


def within(windows: Sequence[int]) -> Tensor:
    """Whether a tap lies in a window, (M, k), k the largest of M windows. Computed, for branches hold no constants."""
    largest = max(windows)
    offset = torch.arange(largest) - largest // 2
    return torch.stack([offset.abs() <= window // 2 for window in windows])


def box_kernels(windows: Sequence[int]) -> Tensor:
    """Columns of ones in zeros, (SUMMED M, 1, k, 1): each channel's own box."""
    return within(windows).float()[:, None].expand(-1, SUMMED, -1).flatten(0, 1)[:, None, :, None]


def careful_sums(logits: Tensor, values: Sequence[Tensor], windows: Sequence[int]) -> Tensor:
    """Box sums (M, C, H, W) relative to the largest of the logits (M, 1, H, W) in every window.

    `values` are C images (1, 1, H, W), 0 where the logits are OUTSIDE_LOGIT. Columns are summed, then rows of these.
    """
    inside = within(windows)[..., None, None]
    largest = max(windows)
    margin = largest // 2
    column = torch.eye(largest)[:, None, :, None]  # the neighbours of a pixel become its channels
    for kernel, (y, x) in ((column, (margin, 0)), (column.transpose(2, 3), (0, margin))):
        entries = F.conv2d(F.pad(logits, (x, x, y, y), value=OUTSIDE_LOGIT), kernel)
        entries = torch.where(inside, entries, OUTSIDE_LOGIT)
        logits = entries.amax(dim=1, keepdim=True)
        weights = torch.exp((entries - logits).clamp(min=MIN_EXPONENT)) * (entries > OUTSIDE_LOGIT)
        values = [(weights * F.conv2d(each, kernel, padding=(y, x))).sum(dim=1, keepdim=True) for each in values]
    return torch.cat(list(values), dim=1)


class BoxWindows(nn.Module):
    """models.networks.fusion.fuse for B = 1, exact for any finite logits like that.

    Logits that span at most SAFE_RANGE, as those of trained networks do, are shifted as a whole. Else a branch is taken
    that is slower and takes memory for some hundred images.
    """

    def __init__(self, windows: Sequence[int]):
        super().__init__()
        self.windows = tuple(windows)

    def forward(self, irradiance: Tensor, importance: Tensor, mixture: Tensor, surface: Tensor) -> Tensor:
        """Filtered irradiance (1, 3, H, W). `surface` (1, 1, H, W) is 1 for pixels that count, else 0."""
        margin = max(self.windows) // 2
        groups = SUMMED * len(self.windows)
        height, width = irradiance.shape[-2:]
        values = torch.cat([irradiance * surface, surface], dim=1)
        high = importance.amax(dim=(2, 3), keepdim=True)
        low = importance.amin(dim=(2, 3), keepdim=True)

        def shifted(importance: Tensor, values: Tensor, surface: Tensor, high: Tensor, low: Tensor) -> Tensor:
            weights = torch.exp(importance - (high + low) / 2)
            products = (weights[:, :, None] * values[:, None]).flatten(1, 2)
            columns = box_kernels(self.windows)
            sums = F.conv2d(products, columns, padding=(margin, 0), groups=groups)
            return F.conv2d(sums, columns.transpose(2, 3), padding=(0, margin), groups=groups)

        def careful(importance: Tensor, values: Tensor, surface: Tensor, high: Tensor, low: Tensor) -> Tensor:
            logits = torch.where(surface > 0, importance, OUTSIDE_LOGIT).transpose(0, 1)
            return careful_sums(logits, values.split(1, dim=1), self.windows).flatten(0, 1)[None]

        within_range = (high - low).max() <= SAFE_RANGE
        sums = torch.cond(within_range, shifted, careful, (importance, values, surface, high, low))
        sums = sums.view(1, len(self.windows), SUMMED, height, width)
        shares = torch.exp(mixture - mixture.amax(dim=1, keepdim=True))  # engines take softmax along channels slowly
        factors = shares[:, :, None] / sums[:, :, 3:].clamp(min=MIN_DIVISOR)
        return (factors * sums[:, :, :3]).sum(dim=1) / shares.sum(dim=1, keepdim=True)
