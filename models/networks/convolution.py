"""A convolution, a sum and ReLU in one pass over memory: on CPUs, passes are most of the time of a wide image."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

FUSED = "_convolution_pointwise"  # what PyTorch's compiler uses; it is not documented and may go


class ConvReLU(nn.Conv2d):
    """relu(convolution(x) + other) with kernels of `size` x `size`, an odd one or the stride.

    Zeros around the image keep its size, which a stride divides.

    Inference on CPUs takes oneDNN's fused operator: PyTorch's own walk over the image up to three times.
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
    """Whether oneDNN's fused operators, which know neither gradients nor autocast nor exports, can take `x`."""
    if torch.compiler.is_compiling():
        return False
    plain = x.device.type == "cpu" and not torch.is_grad_enabled() and not torch.is_autocast_enabled("cpu")
    if not plain or not torch.backends.mkldnn.is_available() or not hasattr(torch.ops.mkldnn, FUSED):
        return False
    return x.dtype == torch.float32 or (x.dtype == torch.bfloat16 and torch.ops.mkldnn._is_mkldnn_bf16_supported())
