"""What stands in for plugins of other versions, missing files and all that is not honoured, and how to say so."""

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from render.backend import mi

Properties = dict[str, Any]  # a Mitsuba dictionary
StandIn = tuple[Properties | None, str]  # None is nothing; and in words what stands there

GREY = {"type": "rgb", "value": [0.5, 0.5, 0.5]}
WHITE_SKY = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
TEXTURES = ("rgb", "spectrum", "bitmap", "checkerboard", "mesh_attribute", "volume", "uniform", "srgb", "rawconstant")
SURFACE_LIGHTS = ("area", "directionalarea")  # which are on shapes; all others are on none
SKIES = ("constant", "envmap", "sunsky")  # of which a scene has one at most


@cache
def plugins() -> frozenset[str]:
    """The names of all plugins that this Mitsuba has."""
    return frozenset(file.stem for file in (Path(mi.__file__).parent / "plugins").iterdir())


def nested(described: Properties) -> list[Properties]:
    """The dictionaries within one that are no colours."""
    values = [value for value in described.values() if isinstance(value, dict)]
    return [value for value in values if value["type"] not in ("rgb", "spectrum")]


def colour_of(described: Properties, *names: str) -> Any:
    """The first of the named colours or textures that there is, or grey."""
    return next((described[name] for name in names if name in described), GREY)


def number_of(described: Properties, name: str, default: float) -> float:
    value = described.get(name, default)
    return float(value) if isinstance(value, int | float) else default


def rough_plastic(described: Properties, alpha: float) -> Properties:
    return {
        "type": "roughplastic",
        "distribution": "ggx",
        "diffuse_reflectance": colour_of(described, "diffuse_reflectance"),
        "alpha": float(np.clip(alpha, 1e-3, 1)),
    }


def phong(described: Properties) -> StandIn:
    """The roughness is that of a Beckmann lobe as wide (Walter et al. 2007, §5.2)."""
    alpha = np.sqrt(2 / (number_of(described, "exponent", 30) + 2))
    return rough_plastic(described, alpha), "a rough plastic of the same colour and sharpness"


def ward(described: Properties) -> StandIn:
    alpha = np.sqrt(number_of(described, "alpha_u", 0.1) * number_of(described, "alpha_v", 0.1))
    return rough_plastic(described, alpha), "a rough plastic of the same colour and sharpness"


def coated(described: Properties) -> StandIn:
    inner = nested(described)
    return (inner[0], "what is under the coat") if inner else (plain_bsdf(described), "a diffuse surface")


def numbers(text: Any) -> list[float]:
    """The numbers in a list as scene files write it; none where it is no such list."""
    try:
        return [float(number) for number in str(text).replace(",", " ").split()]
    except ValueError:
        return []


def mixture(described: Properties) -> StandIn:
    """Two at a time, as blendbsdf mixes them."""
    inner = [value for value in nested(described) if value["type"] in plugins()]
    weights = numbers(described.get("weights", ""))
    if not inner or len(weights) != len(inner):
        return plain_bsdf(described), "a diffuse surface"
    mixed, total = inner[0], weights[0]
    for bsdf, weight in zip(inner[1:], weights[1:], strict=True):
        total += weight
        share = weight / total if total > 0 else 0.5
        mixed = {"type": "blendbsdf", "weight": share, "first": mixed, "second": bsdf}
    return mixed, "the same mixture, by blendbsdf"


def bump(described: Properties) -> StandIn:
    return described | {"type": "bumpmap"}, "bumpmap, its name of today"


def plain_bsdf(described: Properties) -> Properties:
    """A diffuse surface of the same colour."""
    names = ("reflectance", "diffuse_reflectance", "base_color", "transmittance")
    return {"type": "diffuse", "reflectance": colour_of(described, *names)}


def any_bsdf(described: Properties) -> StandIn:
    return plain_bsdf(described), "a diffuse surface of its colour, or grey"


def sky_alone(described: Properties) -> StandIn:
    return described | {"type": "sunsky", "sun_scale": 0.0}, "the sky of sunsky"


def sun_alone(described: Properties) -> StandIn:
    return described | {"type": "sunsky", "sky_scale": 0.0}, "the sun of sunsky"


def scaled(described: Properties) -> StandIn:
    inner = nested(described)
    return (inner[0], "the texture within, at its own brightness") if inner else (GREY, "grey")


def checks(described: Properties) -> StandIn:
    return described | {"type": "checkerboard"}, "a checkerboard"


def image(described: Properties) -> StandIn:
    return described | {"type": "bitmap"}, "bitmap, its name of today"


def nothing(described: Properties) -> StandIn:
    return None, "nothing"


def grey(described: Properties) -> StandIn:
    return GREY, "grey"


# By the plugin's name, of versions before 3.
KNOWN: dict[str, Callable[[Properties], StandIn]] = {
    "phong": phong,
    "ward": ward,
    "coating": coated,
    "roughcoating": coated,
    "mixturebsdf": mixture,
    "bump": bump,
    "sky": sky_alone,
    "sun": sun_alone,
    "scale": scaled,
    "gridtexture": checks,
    "ldrtexture": image,
    "exrtexture": image,
}
# By the kind of object, where the name is not known.
OTHERS: dict[str, Callable[[Properties], StandIn]] = {"BSDF": any_bsdf, "Texture": grey}


def stand_in(kind: str, described: Properties) -> StandIn:
    """What takes the place of an object whose plugin this Mitsuba does not have."""
    return KNOWN.get(described["type"], OTHERS.get(kind, nothing))(described)


def without_relief(described: Properties) -> StandIn | None:
    """Of bump and normal maps, where there is nothing to tell slopes from."""
    bsdfs = [value for value in described.values() if isinstance(value, dict) and value["type"] not in TEXTURES]
    maps = [value["type"] for value in described.values() if isinstance(value, dict) and value["type"] in TEXTURES]
    fits = "bitmap" in maps if described["type"] == "bumpmap" else maps and "rgb" not in maps
    if fits and bsdfs:
        return None
    return (
        bsdfs[0] if bsdfs else plain_bsdf(described)
    ), f"no {described['type']}, whose texture is no bitmap: it is flat"


def empty_volume(described: Properties) -> StandIn | None:
    """Mitsuba crashes where a texture has no volume."""
    found = [value["type"] for value in nested(described)]
    return None if "gridvolume" in found or "constvolume" in found else (GREY, "grey, for its volume is missing")


def lone_bitmap(described: Properties) -> StandIn | None:
    """Mitsuba crashes where a bitmap has neither a file nor values."""
    return None if "filename" in described else (GREY, "grey, for its file is not named")


def bare_spot(described: Properties) -> StandIn | None:
    """A spot that shines through a picture, where that is missing."""
    if described.get("texture") != GREY:
        return None
    return {key: value for key, value in described.items() if key != "texture"}, "a spot without its picture"


def dark_group(described: Properties) -> StandIn | None:
    """Shapes that instances repeat may not shine, in Mitsuba; and there must be some."""
    shapes = {key: value for key, value in described.items() if isinstance(value, dict)}
    if not shapes:
        return None, "a group without shapes is left out"
    dark = {key: without_emitters(value) for key, value in shapes.items()}
    return None if dark == shapes else (described | dark, "shapes that instances repeat do not shine")


def without_emitters(shape: Properties) -> Properties:
    return {key: v for key, v in shape.items() if not (isinstance(v, dict) and v["type"] in SURFACE_LIGHTS)}


def lone_instance(described: Properties) -> StandIn | None:
    return None if nested(described) else (None, "an instance of nothing is left out")


def still_sun(described: Properties) -> StandIn | None:
    """Mitsuba cannot trace a moving sun symbolically, as our path tracer does."""
    return described | {"type": "sunsky"}, "sunsky, whose sun stands still"


def tabulated(wavelengths: Any, values: Any) -> StandIn:
    """A spectrum as Mitsuba makes colours of it."""
    table = [(float(nm), float(value)) for nm, value in zip(wavelengths, values, strict=False)]
    return {"type": "spectrum", "value": table}, "the spectrum is rendered as red, green and blue"


def irregular(described: Properties) -> StandIn:
    return tabulated(numbers(described.get("wavelengths")), numbers(described.get("values")))


def regular(described: Properties) -> StandIn:
    values = numbers(described.get("values"))
    first, last = (number_of(described, f"wavelength_{end}", nm) for end, nm in (("min", 360), ("max", 830)))
    return tabulated(np.linspace(first, last, len(values)), values)


def black_body(described: Properties) -> StandIn:
    """Planck's law, in W / (m² sr nm), as Mitsuba's spectral variants have it."""
    kelvin = max(number_of(described, "temperature", 5000), 100)
    nm = np.arange(360.0, 831.0, 10.0)
    h, c, k = 6.62607015e-34, 299792458.0, 1.380649e-23
    metres = nm * 1e-9
    radiance = 2e-9 * h * c**2 / metres**5 / np.expm1(h * c / (metres * k * kelvin))
    return tabulated(nm, radiance * number_of(described, "scale", 1))


# By the name of a plugin that this Mitsuba has: what stands in where it cannot be rendered as described, else None.
REPAIRS: dict[str, Callable[[Properties], StandIn | None]] = {
    "bumpmap": without_relief,
    "normalmap": without_relief,
    "volume": empty_volume,
    "bitmap": lone_bitmap,
    "spot": bare_spot,
    "shapegroup": dark_group,
    "instance": lone_instance,
    "timed_sunsky": still_sun,
    "irregular": irregular,
    "regular": regular,
    "blackbody": black_body,
}


def repaired(described: Properties) -> StandIn | None:
    """What takes the place of an object that cannot be rendered as described; None where it can."""
    return REPAIRS[described["type"]](described) if described["type"] in REPAIRS else None


def turned_to_y(described: Properties) -> Properties:
    """A sky of versions before 3, whose zenith was y; today's is z."""
    turn = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    return described | {"to_world": described.get("to_world", np.eye(4)) @ turn}
