"""Which channels of a file hold which quantity: by the layer names in use, or by names that the user gives."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from errors import BadInput

COLOUR = "colour"  # the quantity that a frame cannot do without


class LayerNames(NamedTuple):
    names: tuple[str, ...]  # best first; compared without case, spaces, _ and -
    components: tuple[str, ...]  # letters of channel names, best first


RGB_NAMES = ("rgb",)
VECTOR = ("xyz", "rgb")
SCALAR = ("v", "z", "y", "r", "x", "d")
QUANTITIES: dict[str, LayerNames] = {
    COLOUR: LayerNames(("noisyimage", "beauty", "combined", "", "rgba", "rgb", "color", "colour", "c"), RGB_NAMES),
    "buffer_b": LayerNames(("otherhalf",), RGB_NAMES),  # radiance of as many other samples per pixel
    "emission": LayerNames(("emission", "emit"), RGB_NAMES),  # of directly visible surfaces, free of noise
    "albedo": LayerNames(("denoisingalbedo", "albedo", "visiblediffuse", "diffcol", "alb"), RGB_NAMES),
    "normal": LayerNames(  # shading normals
        ("normal", "normals", "ns", "visiblenormals", "optixnormals", "denoisingnormal", "n", "nrm"), VECTOR
    ),
    "depth": LayerNames(("depth", "z", "denoisingdepth"), SCALAR),  # distance along the viewing axis
    "distance": LayerNames(("distance",), SCALAR),  # along the ray
    "position": LayerNames(("p", "position", "positions"), VECTOR),
    "motion": LayerNames(
        ("vector", "motion", "motionvector", "motionvectors", "velocity", "mv", "flow"), ("xyzw", "xy", "uv", "rg")
    ),
    "roughness": LayerNames(("roughness",), SCALAR),  # GGX alpha
    # Of objects or meshes: any numbers that are equal within one and from frame to frame.
    "id": LayerNames(("id", "ids", "objectid", "meshid", "instanceid", "indexob"), SCALAR),
}


class ExrLayer(NamedTuple):
    """A layer of a file, and the names of those of its channels that hold a quantity."""

    name: str
    channels: tuple[str, ...]


def normalised(name: str) -> str:
    """A name without case, spaces, _ and -."""
    return name.casefold().translate({ord(c): None for c in " _-"})


def grouped(channels: Iterable[str]) -> dict[str, dict[str, str]]:
    """Channels by layer and lower-case component; a channel that is a layer by itself has the component "v".

    "Albedo.R" is R of Albedo. Plain "R" is R of the layer "". "Z" and "ViewLayer.Depth" are layers of their own.
    """
    layers: dict[str, dict[str, str]] = {}
    for channel in channels:
        layer, _, component = channel.rpartition(".")
        if len(component) > 1:
            layers[channel] = {"v": channel}
        else:
            layers.setdefault(layer, {})[component.casefold()] = channel
    beside_colour = [
        members["z"] for layer, members in layers.items() if "z" in members and (not layer or "r" in members)
    ]
    return layers | {channel: {"v": channel} for channel in beside_colour}


def layer_of(quantity: str, name: str, members: Mapping[str, str]) -> ExrLayer | None:
    """The layer of the given `members`, if it has the components of the quantity."""
    for letters in QUANTITIES[quantity].components:
        if all(letter in members for letter in letters):
            return ExrLayer(name, tuple(members[letter] for letter in letters))
    return None


def fitting_layers(quantity: str, channels: Iterable[str]) -> list[ExrLayer]:
    """All layers that have the components of a quantity."""
    return [layer for name, members in grouped(channels).items() if (layer := layer_of(quantity, name, members))]


def candidates(quantity: str, channels: Iterable[str]) -> list[ExrLayer]:
    """All layers that hold a quantity by the last part of their names, best first."""
    layers = sorted(fitting_layers(quantity, channels), key=lambda layer: layer.name.casefold().startswith("composite"))
    wanted = QUANTITIES[quantity].names
    return [layer for name in wanted for layer in layers if normalised(layer.name.rpartition(".")[2]) == name]


def parse_layers(options: Sequence[str]) -> dict[str, str]:
    """The layer of each quantity from texts such as "albedo=MyAOV.albedo". Raises BadInput for any other text."""
    layers = {}
    for text in options:
        quantity, equals, layer = text.partition("=")
        if not equals or not layer or quantity not in QUANTITIES:
            form = f"QUANTITY=LAYER, where QUANTITY is one of {', '.join(QUANTITIES)}"
            raise BadInput(f"'{text}' does not name a layer: write {form}")
        layers[quantity] = layer
    return layers


def named_layer(quantity: str, text: str, channels: Sequence[str], file: str) -> ExrLayer:
    """The layer that the user names: a layer's name, or channels "A.X,A.Y". Raises BadInput where it is missing."""
    named = tuple(text.split(","))
    layers = grouped(channels)
    layer = layer_of(quantity, text, layers[text]) if text in layers else None
    if layer is None and set(named) <= set(channels) and len(named) in map(len, QUANTITIES[quantity].components):
        layer = ExrLayer(text, named)
    if layer is None:
        raise BadInput(f"{file} has no layer '{text}' that could be its {quantity}; it has {list_layers(channels)}")
    return layer


def list_layers(channels: Iterable[str]) -> str:
    """The layers with their components: "Albedo.RGB, R, G, B"."""
    layers: dict[str, str] = {}
    for channel in channels:
        layer, dot, component = channel.rpartition(".")
        layers[layer + dot] = layers.get(layer + dot, "") + (component if dot else f"{component} ")
    return ", ".join(f"{layer}{components}".strip() for layer, components in layers.items()) or "no channels"
