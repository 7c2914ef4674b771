"""Which channels of a file hold what: the layer names in use, and those that the user states."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from errors import BadInput


class Known(NamedTuple):
    """The layers that hold a quantity: their names, best first, and the components that they must have."""

    names: tuple[str, ...]  # compared without case, spaces, _ and -
    components: tuple[str, ...]  # letters of channel names, best first
    meaning: str


RGB = ("rgb",)
VECTOR = ("xyz", "rgb")
SCALAR = ("v", "z", "y", "r", "x", "d")
KNOWN: dict[str, Known] = {
    "colour": Known(("noisyimage", "beauty", "combined", "", "rgba", "rgb", "color", "colour", "c"), RGB, "radiance"),
    "half": Known(("otherhalf",), RGB, "radiance by as many other samples a pixel"),
    "emission": Known(("emission", "emit"), RGB, "light seen directly, free of noise"),
    "albedo": Known(("denoisingalbedo", "albedo", "visiblediffuse", "diffcol", "alb"), RGB, "reflectance"),
    "normal": Known(
        ("normal", "normals", "ns", "visiblenormals", "optixnormals", "denoisingnormal", "n", "nrm"),
        VECTOR,
        "shading normals",
    ),
    "depth": Known(("depth", "z", "denoisingdepth"), SCALAR, "distance along the viewing axis"),
    "distance": Known(("distance",), SCALAR, "distance along the ray"),
    "position": Known(("p", "position", "positions"), VECTOR, "where surfaces are"),
    "motion": Known(
        ("vector", "motion", "motionvector", "motionvectors", "velocity", "mv", "flow"),
        ("xyzw", "xy", "uv", "rg"),
        "screen-space motion",
    ),
    "roughness": Known(("roughness",), SCALAR, "GGX alpha"),
}


class Layer(NamedTuple):
    """A layer of a file, and the names of those of its channels that hold a quantity."""

    name: str
    channels: tuple[str, ...]


def plain(name: str) -> str:
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


def layer_of(quantity: str, name: str, members: Mapping[str, str]) -> Layer | None:
    """The layer of the given `members`, if it has the components of the quantity."""
    for letters in KNOWN[quantity].components:
        if all(letter in members for letter in letters):
            return Layer(name, tuple(members[letter] for letter in letters))
    return None


def candidates(quantity: str, channels: Iterable[str]) -> list[Layer]:
    """All layers that hold a quantity by their names, best first, whatever stands before them (`ViewLayer.`)."""
    layers = sorted(grouped(channels).items(), key=lambda item: item[0].casefold().startswith("composite"))
    found = []
    for wanted in KNOWN[quantity].names:
        for name, members in layers:
            if plain(name.rpartition(".")[2]) == wanted and (layer := layer_of(quantity, name, members)):
                found.append(layer)
    return found


def stated_layers(stated: Sequence[str]) -> dict[str, str]:
    """The layer of each quantity from texts such as "albedo=MyAOV.albedo". Raises BadInput for what is no such text."""
    layers = {}
    for text in stated:
        quantity, equals, layer = text.partition("=")
        if not equals or not layer or quantity not in KNOWN:
            raise BadInput(
                f"'{text}' states no layer: write QUANTITY=LAYER, where QUANTITY is one of {', '.join(KNOWN)}"
            )
        layers[quantity] = layer
    return layers


def stated_layer(quantity: str, stated: str, channels: Sequence[str], file: str) -> Layer:
    """The layer that the user states: a layer's name, or channels "A.X,A.Y". Raises BadInput where it is not there."""
    named = tuple(stated.split(","))
    layers = grouped(channels)
    layer = layer_of(quantity, stated, layers[stated]) if stated in layers else None
    if layer is None and set(named) <= set(channels) and len(named) in map(len, KNOWN[quantity].components):
        layer = Layer(stated, named)
    if layer is None:
        raise BadInput(f"{file} has no layer '{stated}' that could be its {quantity}; it has {in_words(channels)}")
    return layer


def in_words(channels: Iterable[str]) -> str:
    """The layers that there are, with their components: "Albedo.RGB, R, G, B"."""
    layers: dict[str, str] = {}
    for channel in channels:
        layer, dot, component = channel.rpartition(".")
        layers[layer + dot] = layers.get(layer + dot, "") + (component if dot else f"{component} ")
    return ", ".join(f"{layer}{components}".strip() for layer, components in layers.items()) or "no channels"
