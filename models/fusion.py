"""Weight-shared kernel construction and fusion (Fan et al. 2021, §3 and §4.2), the heart of WSKP.

A window's weights are exp(I(q)) / sum exp(I(q')): a weight depends on the neighbour q alone, so the filtered image is
the ratio of two box sums. No kernel is ever written out, and the cost hardly grows with the window.
"""

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from models import compiled

WINDOWS = (3, 5, 7, 9, 11, 13)  # §5.3
STRIP = 64  # rows; the temporaries of a strip stay in the cache
SAFE_RANGE = 80.0  # of logits: exp(±40) times any radiance, summed, neither overflows nor vanishes in float32
LEAST_EXPONENT = -80.0  # exp of less is denormal in float32, which is slow; what it leaves is 1e-35
OUTSIDE = -1e30  # logit of a tap outside the image


def box_sum(x: Tensor, window: int, dim: int) -> Tensor:
    """Sums of `window` consecutive entries along `dim`, which gets shorter by window - 1.

    Powers of two of entries are added up, nothing is ever subtracted: running sums would cancel.
    """
    length = x.shape[dim] - window + 1
    total, start, size = None, 0, 1
    while True:
        if window & size:
            part = x.narrow(dim, start, length)
            total = part if total is None else total + part
            start += size
        size *= 2
        if size > window:
            assert total is not None
            return total
        reach = x.shape[dim] - size // 2
        x = x.narrow(dim, 0, reach) + x.narrow(dim, size // 2, reach)


def windowed_max(x: Tensor, window: int, dim: int) -> Tensor:
    """Largest of `window` consecutive entries along `dim`, which gets shorter by window - 1."""
    size = (1, window) if dim == -1 else (window, 1)
    return F.max_pool2d(x, size, stride=1)


def along(dim: int, margin: int) -> tuple[int, ...]:
    """F.pad's argument for `margin` entries on both sides of the last or the last but one dimension."""
    return (margin, margin) if dim == -1 else (0, 0, margin, margin)


def sums_in_steps(logits: Tensor, values: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Box sums relative to the largest logit of every window: first of columns, then of rows of these."""
    top, total = logits, values
    for dim in (-2, -1):
        size, margin = top.shape[dim], window // 2
        entries = F.pad(top, along(dim, margin), value=OUTSIDE)
        parts = F.pad(total, along(dim, margin))
        top, total = windowed_max(entries, window, dim), torch.zeros_like(total)
        for tap in range(window):
            entry = entries.narrow(dim, tap, size)
            weight = torch.exp((entry - top).clamp(min=LEAST_EXPONENT)) * (entry > OUTSIDE)
            total = total + weight * parts.narrow(dim, tap, size)
    return top, total


def windowed_sums(logits: Tensor, values: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """(M, S) with exp(M) S = sum of exp(logits) * values over the window of each pixel, taps outside left out.

    `logits` (B, 1, H, W), any finite numbers; `values` (B, C, H, W); S (B, C, H, W); M (B, 1, H, W) or (1, 1, 1, 1).
    """
    low, high = torch.aminmax(logits)
    if high - low > SAFE_RANGE:
        return sums_in_steps(logits, values, window)
    shift = (low + high) / 2
    weighted = F.pad(values * torch.exp(logits - shift), (window // 2,) * 4)
    return shift.view(1, 1, 1, 1), box_sum(box_sum(weighted, window, -2), window, -1)


def with_ones(image: Tensor) -> Tensor:
    return torch.cat([image, torch.ones_like(image[:, :1])], dim=1)


class SharedKernel(torch.autograd.Function):
    """R(p) = sum exp(I(q)) r(q) / sum exp(I(q)) over the window of p (Eq. 3 and 4).

    With D(p) the denominator and g the gradient of R: dr(q) = exp(I(q)) sum_p g(p) / D(p), over the windows that q lies
    in, and dI(q) = exp(I(q)) sum_p g(p) (r(q) - R(p)) / D(p). That is the same box sum, of logits -ln D.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, logits: Tensor, window: int) -> Tensor:
        top, total = windowed_sums(logits, with_ones(image), window)
        filtered, weight = total[:, :-1] / total[:, -1:], total[:, -1:]
        ctx.window = window
        ctx.save_for_backward(image, logits, filtered, top + torch.log(weight))
        return filtered

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None]:
        image, logits, filtered, log_weight = ctx.saved_tensors
        (gradient,) = gradients
        pulled = torch.cat([gradient, (gradient * filtered).sum(dim=1, keepdim=True)], dim=1)
        top, total = windowed_sums(-log_weight, pulled, ctx.window)
        total = total * torch.exp(logits + top)  # at most 1: no denominator is smaller than its own terms
        to_image = total[:, :-1]
        return to_image, (to_image * image).sum(dim=1, keepdim=True) - total[:, -1:], None


def shared_kernel(image: Tensor, logits: Tensor, window: int) -> Tensor:
    """Filter `image` (B, C, H, W) with the kernels that `logits` (B, 1, H, W) encode (Eq. 3, 4). `window` is odd."""
    filtered: Tensor = SharedKernel.apply(image, logits, window)
    return filtered


def strips(height: int, margin: int) -> Iterator[tuple[slice, slice, slice]]:
    """Rows to compute, rows that they depend on, and the former within the latter."""
    for start in range(0, height, STRIP):
        stop = min(start + STRIP, height)
        low, high = max(start - margin, 0), min(stop + margin, height)
        yield slice(start, stop), slice(low, high), slice(start - low, stop - low)


def fuse_whole(image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int]) -> Tensor:
    shares = torch.softmax(mixture, dim=1)
    parts = [shares[:, [i]] * shared_kernel(image, importance[:, [i]], k) for i, k in enumerate(windows)]
    return torch.stack(parts).sum(dim=0)


def fuse(image: Tensor, importance: Tensor, mixture: Tensor, windows: Sequence[int] = WINDOWS) -> Tensor:
    """Filter an image with shared kernels of several window sizes and mix the results (Eq. 5).

    Args:
        image: (B, C, H, W), finite. importance: I, (B, M, H, W), one map a window; any finite numbers.
        mixture: logits (B, M, H, W) whose softmax over M are the shares alpha. windows: M odd sizes.
    Returns (B, C, H, W): a convex combination of the image's pixels within the largest window, taps outside the image
    left out. Differentiable in the first three.
    """
    training = torch.is_grad_enabled() and any(t.requires_grad for t in (image, importance, mixture))
    colour = image.shape[1] == 3
    if colour and compiled.usable(image, importance, mixture):
        from models.compiled.fusion import fuse as fuse_on_processor

        return fuse_on_processor(image, importance, mixture, windows)
    if colour and not training and image.is_cuda and compiled.enabled and find_spec("triton"):
        from models.compiled.fusion_triton import fuse as fuse_on_gpu

        return fuse_on_gpu(image, importance, mixture, windows)
    if training or image.device.type != "cpu":
        return fuse_whole(image, importance, mixture, windows)
    fused = torch.empty_like(image)
    for rows, needed, within in strips(image.shape[-2], max(windows) // 2):
        part = fuse_whole(image[..., needed, :], importance[..., needed, :], mixture[..., needed, :], windows)
        fused[..., rows, :] = part[..., within, :]
    return fused
