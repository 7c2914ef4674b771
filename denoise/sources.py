"""Where each quantity of a sequence's frames comes from: which file of a frame, and which layer in it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from datasets.channels import CHANNELS, SAMPLE_BUFFERS
from datasets.exr import FACTS_ATTRIBUTE, layer_names
from denoise.exr_image import ExrImage
from denoise.layers import (
    COLOUR,
    QUANTITIES,
    ExrLayer,
    candidates,
    fitting_layers,
    list_layers,
    named_layer,
    normalised,
)
from errors import BadInput

PASS_LAYERS = ("", "rgb", "rgba", "beauty", "combined")  # usual names of the layer in a file with a single pass


@dataclass(frozen=True)
class Source:
    pass_name: str
    layer: ExrLayer
    others: tuple[str, ...] = ()  # further layers that have a name of the quantity

    def __str__(self) -> str:
        also = f" (also there: {', '.join(self.others)})" if self.others else ""
        return f"{self.layer.name or 'R,G,B'}{also}"


@dataclass(frozen=True)
class Sources:
    quantities: dict[str, Source]  # by names of layers.QUANTITIES
    alpha: str | None  # the channel beside the colour that is 0 where a pixel shows nothing
    target: tuple[str, ...]  # the channels of the colour's file that denoised radiance replaces
    is_ours: bool  # whether the files are those of `onespp exr`, with channels and cameras under our own names

    def has(self, *quantities: str) -> bool:
        return any(quantity in self.quantities for quantity in quantities)


def is_ours(image: ExrImage) -> bool:
    """Whether `onespp exr` wrote the file."""
    try:
        facts = json.loads(image.header.get(FACTS_ATTRIBUTE, "null"))
    except (TypeError, ValueError):
        return False
    needed = [f"{layer}.{c}" for layer in ("direct", "indirect", "emission") for c in CHANNELS[layer].letters]
    return isinstance(facts, dict) and all(name in image.channels for name in [*needed, *"RGB"])


def has_two_buffers(image: ExrImage) -> bool:
    """Whether a file that `onespp exr` wrote has two independent sample buffers."""
    return all(f"{layer}.R" in image.channels for name in SAMPLE_BUFFERS.values() for layer in layer_names(name))


def find_sources(images: Mapping[str, ExrImage], named: Mapping[str, str]) -> Sources:
    """The sources in the files of one frame, by pass; layers that the user has `named` are in the colour's file.

    Raises BadInput, listing the layers, where there is no colour, or no layer of such a name.
    """
    image = images[COLOUR]
    channels = list(image.channels)
    if is_ours(image) and len(images) == 1 and not named:
        return Sources({}, None, ("R", "G", "B"), True)
    quantities: dict[str, Source] = {}
    for quantity in QUANTITIES:
        if quantity in named:
            quantities[quantity] = Source(COLOUR, named_layer(quantity, named[quantity], channels, str(image.path)))
        elif quantity in images and quantity != COLOUR:
            quantities[quantity] = Source(quantity, layer_of_pass(quantity, images[quantity], quantities.get(COLOUR)))
        elif layers := candidates(quantity, channels):
            best, *others = layers
            quantities[quantity] = Source(COLOUR, best, tuple(layer.name or "R,G,B" for layer in others))
    if COLOUR not in quantities:
        unknown = f"{image.path} has no layer with a name of radiance; it has {list_layers(channels)}"
        raise BadInput(f"{unknown}: name it by --layers colour=LAYER")
    layer = quantities[COLOUR].layer
    prefix = f"{layer.name}." if layer.name else ""
    alpha = next((name for name in (f"{prefix}A", f"{prefix}a") if name in channels), None)
    return Sources(quantities, alpha, target_of(layer, channels), False)


def layer_of_pass(quantity: str, image: ExrImage, colour: Source | None) -> ExrLayer:
    """The layer in a file of one pass: called like the quantity, plain, or the first. Raises BadInput without.

    The other sample buffer has the layer of the `colour`, if it can.
    """
    channels = list(image.channels)
    if quantity == "buffer_b" and colour and image.channels.keys() >= {*colour.layer.channels}:
        return colour.layer
    fitting = fitting_layers(quantity, channels)
    usual = [layer for name in PASS_LAYERS for layer in fitting if normalised(layer.name) == name]
    choice = [*candidates(quantity, channels), *usual, *fitting]
    if not choice:
        raise BadInput(f"{image.path} has no layer that could be the {quantity}; it has {list_layers(channels)}")
    return choice[0]


def target_of(colour: ExrLayer, channels: Sequence[str]) -> tuple[str, ...]:
    """The channels that denoised radiance replaces: those it was, but Blender's `Combined` for its `Noisy Image`."""
    head, dot, tail = colour.name.rpartition(".")
    if normalised(tail) == "noisyimage":
        for layer in candidates(COLOUR, channels):
            if normalised(layer.name) == normalised(f"{head}{dot}Combined"):
                return layer.channels
    return colour.channels
