"""Weight-shared kernels as the paper writes them (Fan et al. 2021, Eq. 3 to 5): the oracle of kernels and exports."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.fusion import WINDOWS


def unfold_kernel(image: Tensor, logits: Tensor, window: int) -> Tensor:
    """Eq. 3 and 4 of Fan et al. 2021 as written: a kernel map by unfolding, softmax, weighted sum.

    `image` (B, C, H, W), `logits` (B, 1, H, W), a `window` of so many pixels a side; returns (B, C, H, W).
    """
    batch, channels, height, width = image.shape
    margin = window // 2
    entries = F.pad(logits, (margin,) * 4, value=-torch.inf)
    weights = torch.softmax(F.unfold(entries, window), dim=1)  # (B, k k, H W)
    values = F.unfold(F.pad(image, (margin,) * 4), window).view(batch, channels, window**2, -1)
    return (values * weights[:, None]).sum(dim=2).view(batch, channels, height, width)


def unfold_fuse(image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int] = WINDOWS) -> Tensor:
    """Eq. 5: what models.networks.fusion.fuse computes, in the straightforward way; any dtype."""
    shares = torch.softmax(mixture, dim=1)
    parts = [shares[:, [i]] * unfold_kernel(image, importance[:, [i]], k) for i, k in enumerate(windows)]
    return torch.stack(parts).sum(dim=0)
