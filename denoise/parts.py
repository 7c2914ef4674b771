"""Parts of the light and other layers of a frame's file, denoised by the kernels that were chosen for the whole."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from datasets.frame import Frame, to_image, to_tensor
from denoise.exr_image import ExrImage
from denoise.layers import ExrLayer, grouped, list_layers
from errors import BadInput
from models.denoiser import Denoiser, State
from models.layers import blended
from models.networks.one import One


@dataclass(frozen=True)
class Parts:
    """Layers of the colour's file that are denoised beside the colour."""

    layers: Sequence[ExrLayer]  # masks last
    denoiser: One

    @staticmethod
    def named(names: Sequence[str], image: ExrImage, denoiser: Denoiser) -> "Parts | None":
        """The layers of these names, None for no names.

        Raises BadInput where the file has none of a name, and for a denoiser that cannot filter them.
        """
        if not names:
            return None
        if not isinstance(denoiser, One):
            raise BadInput("--aov needs a denoiser that is linear once its kernels are chosen: --denoiser one")
        layers = [part_layer(name, image) for name in names]
        return Parts(sorted(layers, key=is_mask), denoiser)

    def added(self, frame: Frame, image: ExrImage) -> Frame:
        """The frame with these layers of its file, and one layer of glass: parts are divided by its albedo.

        Layers of one channel are masks: they keep the divisor.
        """
        frame = blended(frame) if frame.has_layers else frame
        parts = []
        for layer in self.layers:
            values = to_tensor(image.stacked(layer.channels)).to(frame.divisor)
            parts.append(values * frame.divisor if is_mask(layer) else values)
        return replace(frame, parts=torch.cat(parts, dim=1), masks=sum(map(is_mask, self.layers)))

    def write(self, image: ExrImage, frame: Frame, state: State, dtype: type | None) -> None:
        """Put the denoised layers in place of the noisy ones."""
        frame = frame.finite()
        parts = self.denoiser.parts(frame, state).split(3, dim=1)
        for layer, part in zip(self.layers, parts, strict=True):
            image.replace(layer.channels, planes_of(layer, part, frame.divisor), dtype)


def is_mask(layer: ExrLayer) -> bool:
    return len(layer.channels) == 1


def planes_of(layer: ExrLayer, part: Tensor, divisor: Tensor) -> np.ndarray:
    """(H, W, 3), or (H, W, 1) of a layer of one channel."""
    if is_mask(layer):
        part = (part / divisor).mean(dim=1, keepdim=True)
    return to_image(part)


def part_layer(name: str, image: ExrImage) -> ExrLayer:
    """The layer, or channel, of that name. Raises BadInput where the file has none with R, G and B or one channel."""
    channels = list(image.channels)
    members = grouped(channels).get(name, {})
    if all(letter in members for letter in "rgb"):
        return ExrLayer(name, tuple(members[letter] for letter in "rgb"))
    if name in channels:
        return ExrLayer(name, (name,))
    if len(members) == 1:
        return ExrLayer(name, tuple(members.values()))
    raise BadInput(
        f"{image.path} has no layer or channel '{name}' with R, G and B, or one component; "
        f"it has {list_layers(channels)}"
    )
