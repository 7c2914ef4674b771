"""Networks without the inputs of channels that are constant: to model only what a scene requires."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from models.denoiser import Denoiser


def specialise(denoiser: Denoiser, constants: Mapping[str, Sequence[float]]) -> None:
    """Remove the inputs of `constants` from the network's first convolutions and add their effect to the biases.

    `constants` maps channels to the value that each has in every pixel of every frame; those that the network cannot do
    without stay. The output is the same up to rounding, except near the image border, where convolutions see zeros.
    """
    for name in [name for name in denoiser.inputs if name in denoiser.dispensable and name in constants]:
        names = list(denoiser.inputs)
        first = sum(denoiser.inputs[other] for other in names[: names.index(name)])
        for layer in denoiser.first_layers():
            drop_inputs(layer, first, denoiser.dispensable[name](torch.tensor(constants[name])))
        del denoiser.inputs[name]
        denoiser.constants[name] = list(constants[name])


@torch.no_grad()
def drop_inputs(layer: nn.Conv2d, first: int, values: Tensor) -> None:
    """Remove the inputs from `first` on, which always have these `values`, from a convolution."""
    last = first + len(values)
    assert layer.bias is not None
    layer.bias += layer.weight[:, first:last].sum(dim=(2, 3)) @ values
    kept = torch.cat([layer.weight[:, :first], layer.weight[:, last:]], dim=1)
    layer.weight = nn.Parameter(kept.contiguous(memory_format=torch.channels_last))  # as the images are
    layer.in_channels -= len(values)
