"""Weight-shared kernels as the paper writes them (Fan et al. 2021, Eq. 3 to 5): the oracle of kernels and exports."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from models.compiled.fusion import WINDOWS


def taps(image: Tensor, window: int, step: int = 1) -> Tensor:
    """The windows of an image (B, C, H, W), k taps a side, `step` pixels apart, as (B, C, k k, H, W); 0 outside."""
    batch, channels, height, width = image.shape
    unfolded = F.unfold(image, window, dilation=step, padding=window // 2 * step)
    return unfolded.view(batch, channels, -1, height, width)


def unfold_kernels(image: Tensor, logits: Tensor, surface: Tensor | None = None) -> Tensor:
    """A kernel a pixel: softmax of `logits` (B, k k, H, W) over the taps on the `surface`, weighted sum; 0 without any.

    `image` (B, C, H, W), `surface` (B, 1, H, W), by default the whole image; returns (B, C, H, W).
    """
    window = round(logits.shape[1] ** 0.5)
    there = taps(torch.ones_like(image[:, :1]) if surface is None else surface.to(image), window)[:, 0] > 0
    weights = torch.softmax(torch.where(there, logits, torch.finfo(logits.dtype).min), dim=1) * there
    return (taps(image, window) * weights[:, None]).sum(dim=2)


def unfold_fuse(
    image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int] = WINDOWS, surface: Tensor | None = None
) -> Tensor:
    """Eq. 3 to 5: what models.networks.fusion.fuse computes, in the straightforward way; any dtype."""
    shares = torch.softmax(mixture, dim=1)
    kernels = [taps(importance[:, [i]], k)[:, 0] for i, k in enumerate(windows)]
    parts = [shares[:, [i]] * unfold_kernels(image, kernel, surface) for i, kernel in enumerate(kernels)]
    return torch.stack(parts).sum(dim=0)
