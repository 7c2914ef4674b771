"""Apply a kernel of its own to every pixel: the reconstruction of all kernel-predicting networks.

    output(p) = sum_t w_t(p) image(p + t),  w(p) = softmax of the logits of p over the taps t inside the image

Work goes tap by tap over shifted views of the image, so that no temporary is larger than the image itself.
"""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from models import compiled
from models.compiled import pixel_kernels as kernels


def kernel_taps(logits: Tensor) -> Iterator[tuple[int, Any, Any]]:
    """Of each tap t: its index, the pixels p for which p + t is inside the image, and these p + t, as indices."""
    size = math.isqrt(logits.shape[1])
    height, width = logits.shape[-2:]
    for index in range(size * size):
        dy = index // size - size // 2
        dx = index % size - size // 2
        if abs(dy) < height and abs(dx) < width:
            here = (slice(max(0, -dy), height - max(0, dy)), slice(max(0, -dx), width - max(0, dx)))
            there = (slice(max(0, dy), height + min(0, dy)), slice(max(0, dx), width + min(0, dx)))
            yield index, (..., *here), (..., *there)


class ApplyKernels(torch.autograd.Function):
    """Keeps the softmax's maximum and sum for the way back, and computes the weights again from the logits.

    With g the gradient of the output: d logits_t(p) = w_t(p) g(p) · (image(p + t) - output(p)), and
    d image(q) = sum_t w_t(q - t) g(q - t).
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, logits: Tensor) -> Tensor:
        # The centre is inside the image for every pixel, so that this is the logit of a tap that counts.
        top = logits[:, logits.shape[1] // 2, None].to(image.dtype, copy=True)
        for index, here, _ in kernel_taps(logits):
            top[here] = torch.maximum(top[here], logits[:, index, None][here])
        total = torch.zeros_like(top)
        output = torch.zeros_like(image)
        for index, here, there in kernel_taps(logits):
            weight = torch.exp(logits[:, index, None][here] - top[here])
            total[here] += weight
            output[here].addcmul_(weight, image[there])
        output /= total
        ctx.save_for_backward(image, logits, top, total, output)
        return output

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor]:
        image, logits, top, total, output = ctx.saved_tensors
        (gradient,) = gradients
        to_image = torch.zeros_like(image) if ctx.needs_input_grad[0] else None
        to_logits = torch.zeros_like(logits)
        mean = (gradient * output).sum(dim=1, keepdim=True)
        for index, here, there in kernel_taps(logits):
            weight = torch.exp(logits[:, index, None][here] - top[here]) / total[here]
            if to_image is not None:
                to_image[there].addcmul_(weight, gradient[here])
            product = (gradient[here] * image[there]).sum(dim=1, keepdim=True)
            to_logits[:, index, None][here] = weight * (product - mean[here])
        return to_image, to_logits


@compiled.by(kernels.apply_kernels)
def apply_kernels(image: Tensor, logits: Tensor) -> Tensor:
    """Filter `image` (B, C, H, W) with one k x k kernel a pixel; returns (B, C, H, W). Differentiable in both.

    Args:
        image: float32, finite, linear. Taps outside it are left out.
        logits: (B, k², H, W), k odd, the taps row by row from the top left; any finite numbers, also in half precision.
    """
    # Taps that lie apart in memory would be gathered one by one, several times each.
    filtered: Tensor = ApplyKernels.apply(image, logits.contiguous())
    return filtered
