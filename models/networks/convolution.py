"""Layers of U-Nets. Convolution, sum and ReLU are fused: on CPUs, passes over memory take most of the time."""

from itertools import accumulate

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class ConvReLU(nn.Conv2d):
    """relu(convolution(x) + other) with kernels of `size` x `size`, an odd one or the stride.

    Zero padding; the stride divides the size. Inference on CPUs uses oneDNN's fused operator, which is undocumented.
    """

    def __init__(self, inputs: int, outputs: int, size: int = 3, stride: int = 1):
        super().__init__(inputs, outputs, size, stride, padding=(size - stride) // 2)

    def forward(self, x: Tensor, other: Tensor | None = None) -> Tensor:
        """`other` has the shape of the output; it may be overwritten."""
        if not fusable(x):
            y = super().forward(x)
            return F.relu_(y if other is None else y + other)
        how = self.padding, self.stride, self.dilation, self.groups
        if other is None:
            return torch.ops.mkldnn._convolution_pointwise(x, self.weight, self.bias, *how, "relu", [], "")
        return torch.ops.mkldnn._convolution_pointwise_.binary(
            other, x, self.weight, self.bias, *how, "add", 1.0, "relu", [], ""
        )


def fusable(x: Tensor) -> bool:
    """Whether oneDNN's fused operators can take `x`: they support neither gradients nor autocast nor export."""
    if torch.compiler.is_compiling():
        return False
    plain = x.device.type == "cpu" and not torch.is_grad_enabled() and not torch.is_autocast_enabled("cpu")
    if not plain or not torch.backends.mkldnn.is_available() or not hasattr(torch.ops.mkldnn, "_convolution_pointwise"):
        return False
    return x.dtype == torch.float32 or (x.dtype == torch.bfloat16 and torch.ops.mkldnn._is_mkldnn_bf16_supported())


def encoded(blocks: nn.ModuleList, x: Tensor) -> list[Tensor]:
    """The features of each level of an encoder, finest first: each block gets those before, at half the resolution."""
    first, *others = blocks
    return [*accumulate(others, lambda x, block: block(F.max_pool2d(x, 2)), initial=first(x))]
