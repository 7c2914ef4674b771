"""Networks that do without the inputs of channels that do not vary: to model only what a scene requires."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from models.denoiser import Denoiser


def specialise(denoiser: Denoiser, constants: Mapping[str, Sequence[float]]) -> None:
    """Take out the inputs of those channels of `constants` that the network can do without; biases make up for them.

    `constants` are channels and the value that each has in every pixel of every frame. The output stays the same, up to
    rounding, but near the border of the image: convolutions take zeros for what is outside, in all inputs that they
    have, but a bias goes on there.
    """
    for name in [name for name in denoiser.inputs if name in denoiser.dispensable and name in constants]:
        names = list(denoiser.inputs)
        first = sum(denoiser.inputs[other] for other in names[: names.index(name)])
        seen = denoiser.dispensable[name](torch.tensor(constants[name]))
        for layer in denoiser.first_layers():
            drop_inputs(layer, first, seen)
        del denoiser.inputs[name]
        denoiser.constants[name] = list(constants[name])


@torch.no_grad()
def drop_inputs(layer: nn.Conv2d, first: int, values: Tensor) -> None:
    """Take the inputs from `first` on, which always have these `values`, out of a convolution."""
    last = first + len(values)
    assert layer.bias is not None
    layer.bias += layer.weight[:, first:last].sum(dim=(2, 3)) @ values
    kept = torch.cat([layer.weight[:, :first], layer.weight[:, last:]], dim=1)
    layer.weight = nn.Parameter(kept.contiguous(memory_format=torch.channels_last))  # as the images are
    layer.in_channels -= len(values)
