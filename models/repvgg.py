"""RepVGG blocks (Ding et al. 2021, as varied by Fan et al. 2021, §4.1): many branches to train, one to run."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

SIZES = (1, 3, 5)


class RepVGGBlock(nn.Module):
    """Parallel 1 x 1, 3 x 3 and 5 x 5 convolutions, and identity where widths match, summed; then ReLU or nothing.

    `merge` turns the branches into one 5 x 5 convolution with the same output up to rounding.
    """

    def __init__(self, inputs: int, outputs: int, relu: bool):
        super().__init__()
        self.relu, self.has_identity = relu, inputs == outputs
        self.branches: Sequence[nn.Conv2d] = nn.ModuleList(  # type: ignore[assignment]
            nn.Conv2d(inputs, outputs, size, padding=size // 2) for size in SIZES
        )
        self.merged: nn.Conv2d | None = None

    def merge(self) -> None:
        """Replace the branches; there is no way back to training."""
        if self.merged is not None:
            return
        size, largest = SIZES[-1], self.branches[-1]
        merged = nn.Conv2d(largest.in_channels, largest.out_channels, size, padding=size // 2)
        weight, bias = torch.zeros_like(largest.weight), torch.zeros(largest.out_channels).to(largest.weight)
        for branch in self.branches:
            margin = (size - branch.weight.shape[-1]) // 2
            weight += F.pad(branch.weight, (margin,) * 4)
            assert branch.bias is not None
            bias += branch.bias
        if self.has_identity:
            weight[:, :, size // 2, size // 2] += torch.eye(len(weight), device=weight.device)
        merged.weight, merged.bias = nn.Parameter(weight, False), nn.Parameter(bias, False)
        self.merged, self.branches = merged, nn.ModuleList()  # type: ignore[assignment]

    def forward(self, x: Tensor) -> Tensor:
        if self.merged is not None:
            y = self.merged(x)
        else:
            y = sum((branch(x) for branch in self.branches), start=x if self.has_identity else torch.zeros(()).to(x))
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
