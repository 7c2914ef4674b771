"""RepVGG blocks (Ding et al. 2021, as varied by Fan et al. 2021, §4.1): many branches to train, one to run."""

from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

BRANCH_SIZES = (1, 3, 5)
LANES = 16  # float32 numbers in a vector register


class PairedConv2d(nn.Conv2d):
    """A convolution that on CPUs treats two neighbouring pixels as one with twice the channels.

    Faster where the outputs of one pixel leave half a register idle and those of two fill it. In channels-last layout
    no memory is moved.
    """

    def pair(self) -> None:
        """Compute the weights for pairs, (2 outputs, 2 inputs, k, (k + 1) / 2), and their bias; k is 5, 9, ..."""
        outputs, inputs, size, _ = self.weight.shape
        middle = size // 4
        weight = self.weight.new_zeros(2, outputs, 2, inputs, size, 2 * middle + 1)
        for pixel in range(2):
            for tap in range(size):
                pairs, other = divmod(pixel + tap - size // 2, 2)
                weight[pixel, :, other, :, :, middle + pairs] = self.weight[..., tap]
        assert self.bias is not None
        self.pair_weight = nn.Buffer(weight.flatten(2, 3).flatten(0, 1), persistent=False)
        self.pair_bias = nn.Buffer(self.bias.repeat(2), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        if x.device.type != "cpu":
            return super().forward(x)
        width = x.shape[-1]
        x = F.pad(x, (0, 1)) if width % 2 else x
        batch, channels, height, even = x.shape
        pairs = x.permute(0, 2, 3, 1).reshape(batch, height, even // 2, 2 * channels).permute(0, 3, 1, 2)
        margin = (self.pair_weight.shape[2] // 2, self.pair_weight.shape[3] // 2)
        y = F.conv2d(pairs, self.pair_weight, self.pair_bias, padding=margin)
        return y.permute(0, 2, 3, 1).reshape(batch, height, even, -1).permute(0, 3, 1, 2)[..., :width]


class RepVGGBlock(nn.Module):
    """Parallel 1 x 1, 3 x 3 and 5 x 5 convolutions, and identity where widths match, summed; then ReLU or nothing.

    The sum of the branches is one convolution with the sum of their kernels, also in training: gradients reach every
    branch through the sum. `merge` makes it permanent.
    """

    def __init__(self, inputs: int, outputs: int, relu: bool):
        super().__init__()
        self.relu = relu
        self.has_identity = inputs == outputs
        self.branches: Sequence[nn.Conv2d] = nn.ModuleList(  # type: ignore[assignment]
            nn.Conv2d(inputs, outputs, size, padding=size // 2) for size in BRANCH_SIZES
        )
        self.merged: nn.Conv2d | None = None

    def kernel(self) -> tuple[Tensor, Tensor]:
        """Weight (outputs, inputs, k, k), k the largest size, and bias (outputs,) of the branches' sum."""
        reach = max(BRANCH_SIZES) // 2
        weights = [F.pad(branch.weight, (reach - branch.kernel_size[0] // 2,) * 4) for branch in self.branches]
        biases = [cast(Tensor, branch.bias) for branch in self.branches]
        if self.has_identity:
            eye = torch.eye(len(biases[0]), dtype=biases[0].dtype, device=biases[0].device)
            weights.append(F.pad(eye[:, :, None, None], (reach,) * 4))
        return torch.stack(weights).sum(dim=0), torch.stack(biases).sum(dim=0)

    def merge(self) -> None:
        """Replace the branches by their sum; there is no way back to training."""
        if self.merged is not None:
            return
        weight, bias = self.kernel()
        outputs, inputs, size = weight.shape[:3]
        kind = PairedConv2d if outputs % LANES == LANES // 2 and size == 5 else nn.Conv2d
        merged = kind(inputs, outputs, size, padding=size // 2)
        merged.weight = nn.Parameter(weight, False)
        merged.bias = nn.Parameter(bias, False)
        if isinstance(merged, PairedConv2d):
            merged.pair()
        self.merged = merged
        self.branches = nn.ModuleList()  # type: ignore[assignment]

    def forward(self, x: Tensor) -> Tensor:
        if self.merged is not None:
            y = self.merged(x)
        else:
            weight, bias = self.kernel()
            y = F.conv2d(x, weight, bias, padding=weight.shape[-1] // 2)
        return F.relu(y, inplace=True) if self.relu else y


def repvgg(widths: Sequence[int]) -> nn.Sequential:
    """Blocks from widths[0] channels to widths[-1], the last one linear."""
    pairs = list(pairwise(widths))
    return nn.Sequential(*(RepVGGBlock(a, b, relu=i + 1 < len(pairs)) for i, (a, b) in enumerate(pairs)))


@torch.no_grad()
def merge(network: nn.Module) -> None:
    """Merge all RepVGG blocks in a network."""
    for module in network.modules():
        if isinstance(module, RepVGGBlock):
            module.merge()
