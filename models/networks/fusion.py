"""Weight-shared kernel construction and fusion (Fan et al. 2021, §3 and §4.2).

A window's weights are exp(I(q)) / sum exp(I(q')): a weight depends on the neighbour q alone, so the filtered image is
the ratio of two box sums. No kernel is materialised, and the cost hardly grows with the window.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from models import compiled
from models.compiled import fusion as kernels
from models.compiled.exponential import MIN_EXPONENT
from models.compiled.fusion import OUTSIDE_LOGIT, SAFE_RANGE, WINDOWS
from models.operators import MIN_DIVISOR, STRIP_ROWS


def box_sum(x: Tensor, window: int, dim: int) -> Tensor:
    """Sums of `window` consecutive entries, an odd number, along `dim`, which gets shorter by window - 1.

    Sums of powers of two of entries are combined; running sums would suffer from cancellation.
    """
    length = x.shape[dim] - window + 1
    total = x.narrow(dim, 0, length)
    start = size = 1
    while 2 * size <= window:
        reach = x.shape[dim] - size
        x = x.narrow(dim, 0, reach) + x.narrow(dim, size, reach)
        size *= 2
        if window & size:
            total = total + x.narrow(dim, start, length)
            start += size
    return total


def sums_in_steps(logits: Tensor, values: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Box sums relative to the maximum logit of every window: of columns, then of rows of these."""
    margin = window // 2
    top = logits
    total = values
    for dim, padding, shape in ((-2, (0, 0, margin, margin), (window, 1)), (-1, (margin, margin), (1, window))):
        size = top.shape[dim]
        entries = F.pad(top, padding, value=OUTSIDE_LOGIT)
        parts = F.pad(total, padding)
        top = F.max_pool2d(entries, shape, stride=1)
        total = torch.zeros_like(total)
        for tap in range(window):
            entry = entries.narrow(dim, tap, size)
            weight = torch.exp((entry - top).clamp(min=MIN_EXPONENT)) * (entry > OUTSIDE_LOGIT)
            total = total + weight * parts.narrow(dim, tap, size)
    return top, total


def windowed_sums(logits: Tensor, values: Tensor, window: int, counted: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """(M, S) with exp(M) S = sum of exp(logits) * values over the window of each pixel, taps outside left out.

    `logits` (B, 1, H, W), any finite numbers; `values` (B, C, H, W); S (B, C, H, W); M (B, 1, H, W) or (1, 1, 1, 1).
    With `counted` (B, 1, H, W), bool, other pixels are left out as well.
    """
    low, high = torch.aminmax(logits)
    if counted is not None:
        logits = torch.where(counted, logits, OUTSIDE_LOGIT)
        values = torch.where(counted, values, 0)
        high = logits.amax()
        low = torch.where(counted, logits, high).amin()
    if high - low > SAFE_RANGE:
        return sums_in_steps(logits, values, window)
    shift = (low + high) / 2
    weighted = F.pad(values * torch.exp(logits - shift), (window // 2,) * 4)
    return shift.view(1, 1, 1, 1), box_sum(box_sum(weighted, window, -2), window, -1)


class SharedKernel(torch.autograd.Function):
    """R(p) = sum exp(I(q)) r(q) / sum exp(I(q)) over the pixels of a surface in the window of p (Eq. 3 and 4).

    The image r is (B, C, H, W), the logits I are (B, 1, H, W), as is the surface.

    With D(p) the denominator and g the gradient of R: dr(q) = exp(I(q)) sum_p g(p) / D(p), over the windows that q lies
    in, and dI(q) = exp(I(q)) sum_p g(p) (r(q) - R(p)) / D(p). That is the same box sum, of logits -ln D.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, logits: Tensor, window: int, surface: Tensor | None = None) -> Tensor:
        counted = None if surface is None else surface > 0
        values = torch.cat([image, torch.ones_like(image[:, :1])], dim=1)
        top, total = windowed_sums(logits, values, window, counted)
        weight = total[:, -1:]
        filtered = total[:, :-1] / weight.clamp(min=MIN_DIVISOR)
        ctx.window = window
        ctx.save_for_backward(image, logits, counted, filtered, top + torch.log(weight))
        return filtered

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        image, logits, counted, filtered, log_weight = ctx.saved_tensors
        (gradient,) = gradients
        pulled = torch.cat([gradient, (gradient * filtered).sum(dim=1, keepdim=True)], dim=1)
        # Windows without any surface are 0 whatever the inputs; pixels without one are in no window.
        filled = None if counted is None else log_weight.isfinite()
        top, total = windowed_sums(-log_weight, pulled, ctx.window, filled)
        scale = torch.exp(logits + top)  # at most 1: no denominator is smaller than its own terms
        total = total * (scale if counted is None else torch.where(counted, scale, 0))
        to_image = total[:, :-1]
        return to_image, (to_image * image).sum(dim=1, keepdim=True) - total[:, -1:], None, None


def fuse_whole(
    image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int], surface: Tensor | None
) -> Tensor:
    filtered = (SharedKernel.apply(image, importance[:, [i]], k, surface) for i, k in enumerate(windows))
    shares = torch.softmax(mixture, dim=1).split(1, dim=1)
    return torch.stack([share * part for share, part in zip(shares, filtered, strict=True)]).sum(dim=0)


@compiled.by(kernels.fuse)
def fuse(
    image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int] = WINDOWS, surface: Tensor | None = None
) -> Tensor:
    """Filter a finite image (B, 3, H, W) with shared kernels of M odd window sizes and mix the results (Eq. 5).

    Importance I and mixture are (B, M, H, W), any finite numbers; the shares alpha are the mixture's softmax over M.
    Pixels off the `surface` (B, 1, H, W) are left out, by default none. The result is a convex combination of pixels
    within the largest window; a window without any pixel that counts adds 0. Differentiable in the first three.
    """
    training = torch.is_grad_enabled() and any(t.requires_grad for t in (image, importance, mixture))
    if training or image.device.type != "cpu":
        return fuse_whole(image, importance, mixture, windows, surface)
    strips = []
    for top in range(0, image.shape[-2], STRIP_ROWS):
        first = max(top - max(windows) // 2, 0)
        rows = slice(first, top + STRIP_ROWS + max(windows) // 2)
        valid = None if surface is None else surface[..., rows, :]
        part = fuse_whole(image[..., rows, :], importance[..., rows, :], mixture[..., rows, :], windows, valid)
        strips.append(part[..., top - first : top - first + STRIP_ROWS, :])
    return torch.cat(strips, dim=-2)
