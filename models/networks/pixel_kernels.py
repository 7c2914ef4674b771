"""Apply a kernel of its own to every pixel: the reconstruction of all kernel-predicting networks.

    output(p) = sum_t w_t(p) image(p + t),  w(p) = softmax of the logits of p over the taps t inside the image

Work goes tap by tap over shifted views of the image, so that no temporary is larger than the image itself.
"""

import math
from collections.abc import Iterator
from typing import Any, cast

import torch
from torch import Tensor

from models import compiled
from models.compiled import pixel_kernels as kernels


def window_taps(side: int, height: int, width: int) -> Iterator[tuple[int, Any, Any]]:
    """Of each tap t of a window, row by row: its index, the pixels p with p + t inside, and these p + t, as indices."""
    for index in range(side * side):
        dy = index // side - side // 2
        dx = index % side - side // 2
        if abs(dy) < height and abs(dx) < width:
            here = (slice(max(0, -dy), height - max(0, dy)), slice(max(0, -dx), width - max(0, dx)))
            there = (slice(max(0, dy), height + min(0, dy)), slice(max(0, dx), width + min(0, dx)))
            yield index, (..., *here), (..., *there)


def kernel_taps(logits: Tensor) -> Iterator[tuple[int, Any, Any]]:
    """The taps of the kernels that logits (B, k², H, W) stand for."""
    return window_taps(math.isqrt(logits.shape[1]), logits.shape[-2], logits.shape[-1])


def tap_logit(logits: Tensor, index: int, here: Any, there: Any, surface: Tensor | None) -> Tensor:
    """The logits (B, 1, h, w) of a tap, -inf where it shows no surface."""
    logit = logits[:, index, None][here]
    return logit if surface is None else torch.where(surface[there] > 0, logit, -torch.inf)


class ApplyKernels(torch.autograd.Function):
    """Keeps the softmax's maximum and sum for the way back, and computes the weights again from the logits.

    With g the gradient of the output: d logits_t(p) = w_t(p) g(p) · (image(p + t) - output(p)), and
    d image(q) = sum_t w_t(q - t) g(q - t).
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, logits: Tensor, surface: Tensor | None = None) -> Tensor:
        top = torch.full_like(image[:, :1], -torch.inf)
        for index, here, there in kernel_taps(logits):
            top[here] = torch.maximum(top[here], tap_logit(logits, index, here, there, surface))
        top = torch.where(top.isneginf(), 0, top)  # without any surface all weights are 0
        total = torch.zeros_like(top)
        output = torch.zeros_like(image)
        for index, here, there in kernel_taps(logits):
            weight = torch.exp(tap_logit(logits, index, here, there, surface) - top[here])
            total[here] += weight
            output[here].addcmul_(weight, image[there])
        total.clamp_(min=1)  # the largest logit's own weight is 1
        output /= total
        ctx.save_for_backward(image, logits, surface, top, total, output)
        return output

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, None]:
        image, logits, surface, top, total, output = ctx.saved_tensors
        (gradient,) = gradients
        to_image = torch.zeros_like(image) if ctx.needs_input_grad[0] else None
        to_logits = torch.zeros_like(logits)
        mean = (gradient * output).sum(dim=1, keepdim=True)
        for index, here, there in kernel_taps(logits):
            weight = torch.exp(tap_logit(logits, index, here, there, surface) - top[here]) / total[here]
            if to_image is not None:
                to_image[there].addcmul_(weight, gradient[here])
            product = (gradient[here] * image[there]).sum(dim=1, keepdim=True)
            to_logits[:, index, None][here] = weight * (product - mean[here])
        return to_image, to_logits, None


@compiled.by(kernels.apply_kernels)
def apply_kernels(image: Tensor, logits: Tensor, surface: Tensor | None = None) -> Tensor:
    """Filter a finite `image` (B, C, H, W) with one k x k kernel a pixel. Differentiable in both.

    The logits (B, k², H, W), k odd, are taps row by row from the top left, any finite numbers, also in half precision.
    Taps outside the image or off the `surface` (B, 1, H, W) are left out; where none is left, the output is 0.
    """
    # Taps that lie apart in memory would be gathered one by one, several times each.
    return cast(Tensor, ApplyKernels.apply(image, logits.contiguous(), surface))
