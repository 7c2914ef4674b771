"""Where each quantity of a sequence's frames comes from: which file of a frame, and which layer in it."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from datasets.channels import CHANNELS, SAMPLE_BUFFERS
from datasets.exr import FACTS_ATTRIBUTE, layer_names
from denoise.exr_image import ExrImage
from denoise.layers import KNOWN, Layer, candidates, grouped, in_words, layer_of, plain, stated_layer
from denoise.sequence import COLOUR
from errors import BadInput

PASS_LAYERS = ("", "rgb", "rgba", "beauty", "combined")  # what a pass of its own may be called in its file


@dataclass(frozen=True)
class Source:
    """A layer of one of a frame's files."""

    pass_name: str
    layer: Layer
    others: tuple[str, ...] = ()  # layers that could have been meant as well


@dataclass(frozen=True)
class Sources:
    """Where everything is.

    Attributes:
        quantities: by names of layers.KNOWN.
        alpha: the channel beside the colour that is 0 where a pixel shows nothing.
        target: the channels of the colour's file that denoised radiance replaces.
        is_ours: whether the files are those of `onespp exr`, with channels and cameras under our own names.
    """

    quantities: dict[str, Source]
    alpha: str | None
    target: tuple[str, ...]
    is_ours: bool

    def has(self, *quantities: str) -> bool:
        """Whether there is any of the quantities."""
        return any(quantity in self.quantities for quantity in quantities)


def is_ours(image: ExrImage) -> bool:
    """Whether `onespp exr` wrote the file."""
    try:
        facts = json.loads(image.header.get(FACTS_ATTRIBUTE, "null"))
    except (TypeError, ValueError):
        return False
    needed = [f"{layer}.{c}" for layer in ("direct", "indirect", "emission") for c in CHANNELS[layer].letters]
    return isinstance(facts, dict) and all(name in image.channels for name in [*needed, *"RGB"])


def has_halves(image: ExrImage) -> bool:
    """Whether a file that `onespp exr` wrote holds the halves of its samples."""
    return all(f"{layer}.R" in image.channels for name in SAMPLE_BUFFERS.values() for layer in layer_names(name))


def find_sources(images: Mapping[str, ExrImage], stated: Mapping[str, str]) -> Sources:
    """Look through the files of one frame, by pass. What is `stated` by the user is in the colour's file.

    Raises BadInput where there is no colour, or not what was stated, with what there is instead.
    """
    colour_image = images[COLOUR]
    channels = list(colour_image.channels)
    if is_ours(colour_image) and len(images) == 1 and not stated:
        return Sources({}, None, ("R", "G", "B"), True)
    quantities: dict[str, Source] = {}
    for quantity in KNOWN:
        if quantity in stated:
            quantities[quantity] = Source(
                COLOUR, stated_layer(quantity, stated[quantity], channels, str(colour_image.path))
            )
        elif quantity in images and quantity != COLOUR:
            quantities[quantity] = Source(quantity, layer_of_pass(quantity, images[quantity]))
        elif found := candidates(quantity, channels):
            best, *others = found
            quantities[quantity] = Source(COLOUR, best, tuple(layer.name or "R,G,B" for layer in others))
    if COLOUR not in quantities:
        raise BadInput(
            f"{colour_image.path} has no layer known to be radiance; it has {in_words(channels)}: "
            "state it by --layers colour=LAYER"
        )
    layer = quantities[COLOUR].layer
    prefix = f"{layer.name}." if layer.name else ""
    alpha = next((name for name in (f"{prefix}A", f"{prefix}a") if name in colour_image.channels), None)
    return Sources(quantities, alpha, target_of(layer, channels), False)


def layer_of_pass(quantity: str, image: ExrImage) -> Layer:
    """The layer of a file that holds one pass: one with a name of the quantity's, or else its only or plain layer."""
    channels = list(image.channels)
    found = candidates(quantity, channels)
    plain_ones = [layer for name in PASS_LAYERS for layer in any_layer(quantity, channels) if plain(layer.name) == name]
    choice = [*found, *plain_ones, *any_layer(quantity, channels)]
    if not choice:
        raise BadInput(f"{image.path} has no layer that could be the {quantity}; it has {in_words(channels)}")
    return choice[0]


def any_layer(quantity: str, channels: Sequence[str]) -> list[Layer]:
    """All layers with the components of the quantity, whatever their names."""
    found = (layer_of(quantity, name, members) for name, members in grouped(channels).items())
    return [layer for layer in found if layer]


def target_of(colour: Layer, channels: Sequence[str]) -> tuple[str, ...]:
    """The channels that denoised radiance replaces: those it was, but Blender's `Combined` for its `Noisy Image`."""
    head, dot, tail = colour.name.rpartition(".")
    if plain(tail) == "noisyimage":
        combined = [
            layer for layer in candidates("colour", channels) if plain(layer.name) == plain(f"{head}{dot}Combined")
        ]
        if combined:
            return combined[0].channels
    return colour.channels
