"""Stand-ins for plugins of other Mitsuba versions, missing files and unsupported content, and notes that name them."""

import math
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from render.backend import mi
from scenes.colours import diffuse_bsdf, rgb

Properties = dict[str, Any]  # a Mitsuba dictionary
StandIn = tuple[Properties | None, str]  # None is nothing; and a description of it

GREY = rgb([0.5, 0.5, 0.5])
GAIN = "_gain"  # of the texture of a bump map: a key in descriptions that Mitsuba does not get
TEXTURES = ("rgb", "spectrum", "bitmap", "checkerboard", "mesh_attribute", "volume", "uniform", "srgb", "rawconstant")
RESERVED_NAMES = ("type", "id", "sky")  # keys of a Mitsuba scene's dictionary
DEFAULT_ALPHA = 0.1  # Mitsuba's roughness of surfaces
SURFACE_LIGHTS = ("area", "directionalarea")  # emitters that belong to shapes, unlike all others


class Names:
    def __init__(self) -> None:
        self.given = set(RESERVED_NAMES)
        self.asked: Counter[str] = Counter()

    def unique(self, wanted: str) -> str:
        """The wanted name without dots, which separate a name from its parameters; numbered if it is taken."""
        plain = name = wanted.replace(".", "_") or "unnamed"
        while name in self.given:
            self.asked[plain] += 1
            name = f"{plain}-{self.asked[plain] + 1}"
        self.given.add(name)
        return name


@cache
def plugins() -> frozenset[str]:
    """The names of all plugins of this Mitsuba."""
    return frozenset(file.stem for file in (Path(mi.__file__).parent / "plugins").iterdir())


def nested(described: Properties) -> list[Properties]:
    """The nested dictionaries that are no colours."""
    values = [value for value in described.values() if isinstance(value, dict)]
    return [value for value in values if value["type"] not in ("rgb", "spectrum")]


def colour_of(described: Properties, *names: str) -> Any:
    """The first of the named colours or textures, or grey."""
    return next((described[name] for name in names if name in described), GREY)


def number_of(described: Properties, name: str, default: float) -> float:
    value = described.get(name, default)
    return float(value) if isinstance(value, int | float) else default


def numbers(text: Any) -> list[float]:
    """The numbers in a list of a scene file; none if it is malformed."""
    try:
        return [float(number) for number in str(text).replace(",", " ").split()]
    except ValueError:
        return []


def plain_bsdf(described: Properties) -> Properties:
    """A diffuse surface of the same colour."""
    return diffuse_bsdf(colour_of(described, "reflectance", "diffuse_reflectance", "base_color", "transmittance"))


def rough_plastic(described: Properties, alpha: float) -> StandIn:
    colour = {"diffuse_reflectance": colour_of(described, "diffuse_reflectance")}
    bsdf = {"type": "roughplastic", "distribution": "ggx", **colour, "alpha": float(np.clip(alpha, 1e-3, 1))}
    return bsdf, "a rough plastic of the same colour and sharpness"


def phong(described: Properties) -> StandIn:
    """The roughness is that of a Beckmann lobe of the same width (Walter et al. 2007, §5.2)."""
    return rough_plastic(described, np.sqrt(2 / (number_of(described, "exponent", 30) + 2)))


def ward(described: Properties) -> StandIn:
    alphas = [number_of(described, name, DEFAULT_ALPHA) for name in ("alpha_u", "alpha_v")]
    return rough_plastic(described, np.sqrt(alphas[0] * alphas[1]))


def coated(described: Properties) -> StandIn:
    inner = [value for value in nested(described) if value["type"] not in TEXTURES]
    return (inner[0], "what is under the coat") if inner else (plain_bsdf(described), "a diffuse surface")


def mixture(described: Properties) -> StandIn:
    inner = [value for value in nested(described) if value["type"] in plugins()]
    weights = numbers(described.get("weights", ""))
    if not inner or len(weights) != len(inner):
        return plain_bsdf(described), "a diffuse surface"
    mixed, total = inner[0], weights[0]
    for bsdf, weight in zip(inner[1:], weights[1:], strict=True):
        total += weight
        share = weight / total if total > 0 else 0.5
        mixed = {"type": "blendbsdf", "weight": share, "first": mixed, "second": bsdf}
    if total < 1:  # the rest is absorbed
        mixed = {"type": "blendbsdf", "weight": 1 - total, "first": mixed, "second": diffuse_bsdf(rgb([0.0] * 3))}
    return mixed, "the same mixture, by blendbsdf"


def scaled(described: Properties) -> StandIn:
    """Constant colours are multiplied; other textures keep the factor, for relief."""
    scale = described.get("scale")
    factor = scale["value"] if isinstance(scale, dict) and scale["type"] == "rgb" else number_of(described, "scale", 1)
    inner = [value for name, value in described.items() if isinstance(value, dict) and name != "scale"]
    if not inner:
        return GREY, "grey"
    if inner[0]["type"] == "rgb":
        return rgb(np.multiply(inner[0]["value"], factor).tolist()), "its colour, scaled"
    gain = inner[0].get(GAIN, 1) * float(np.mean(factor))
    return inner[0] | {GAIN: gain}, "the texture within, at its own brightness unless it is relief"


def with_properties(words: str, **properties: Any) -> Callable[[Properties], StandIn]:
    """Keeps the dictionary, but for some properties."""
    return lambda described: (described | properties, words)


def old_sky(described: Properties) -> StandIn:
    sky = {"type": "sunsky", "sky_scale": 1.0, "sun_scale": 0.0}
    return sky | renamed(described, scale="sky_scale"), "the sky of sunsky"


def old_sun(described: Properties) -> StandIn:
    degrees = 0.5358 * number_of(described, "sun_radius_scale", 1.0)
    sun = {"type": "sunsky", "sun_scale": 1.0, "sky_scale": 0.0, "sun_aperture": degrees}
    return sun | renamed(described, scale="sun_scale", sun_radius_scale=None), "the sun of sunsky"


def renamed(described: Properties, **names: str | None) -> Properties:
    """The properties but for the type, some of them under other names, or left out."""
    pairs = ((names.get(name, name), value) for name, value in described.items() if name != "type")
    return {name: value for name, value in pairs if name is not None}


# By plugins of versions before 3.
OLD_PLUGINS: dict[str, Callable[[Properties], StandIn]] = {
    "phong": phong,
    "ward": ward,
    **dict.fromkeys(("coating", "roughcoating"), coated),
    "mixturebsdf": mixture,
    "bump": with_properties("bumpmap, its current name", type="bumpmap"),
    "sky": old_sky,
    "sun": old_sun,
    "scale": scaled,
    "gridtexture": with_properties("a checkerboard", type="checkerboard"),
    **dict.fromkeys(("ldrtexture", "exrtexture"), with_properties("bitmap, its current name", type="bitmap")),
    "perspective_rdist": with_properties("a perspective camera without distortion", type="perspective"),
}


def stand_in(kind: str, described: Properties) -> StandIn:
    """The stand-in for an object of some kind whose plugin this Mitsuba does not have."""
    if described["type"] in OLD_PLUGINS:
        return OLD_PLUGINS[described["type"]](described)
    if kind == "BSDF":
        return plain_bsdf(described), "a diffuse surface of its colour, or grey"
    return (GREY, "grey") if kind == "Texture" else (None, "nothing")


def without_relief(described: Properties) -> StandIn | None:
    """Bump and normal maps need textures with slopes."""
    bsdfs = [value for value in described.values() if isinstance(value, dict) and value["type"] not in TEXTURES]
    maps = [value["type"] for value in described.values() if isinstance(value, dict) and value["type"] in TEXTURES]
    fits = "bitmap" in maps if described["type"] == "bumpmap" else maps and "rgb" not in maps
    if fits and bsdfs:
        factor = math.prod(value.get(GAIN, 1.0) for value in described.values() if isinstance(value, dict))
        return None if factor == 1 else (described | {"scale": number_of(described, "scale", 1) * factor}, "")
    flat = bsdfs[0] if bsdfs else plain_bsdf(described)
    return flat, f"a flat surface without {described['type']}, whose texture is no bitmap"


def has_volume(described: Properties) -> bool:
    return any(value["type"] in ("gridvolume", "constvolume") for value in nested(described))


def spot_without_texture(described: Properties) -> StandIn | None:
    if described.get("texture") != GREY:
        return None
    return {key: value for key, value in described.items() if key != "texture"}, "a spot without its texture"


def dark_group(described: Properties) -> StandIn | None:
    """In Mitsuba, groups for instances must have shapes, which cannot emit light."""
    shapes = {key: value for key, value in described.items() if isinstance(value, dict)}
    if not shapes:
        return None, "a group without shapes is left out"

    def emits(part: Any) -> bool:
        return isinstance(part, dict) and part["type"] in SURFACE_LIGHTS

    dark = {name: {key: part for key, part in shape.items() if not emits(part)} for name, shape in shapes.items()}
    return None if dark == shapes else (described | dark, "instanced shapes do not emit light")


def tabulated(wavelengths: Any, values: Any) -> StandIn:
    """A spectrum that Mitsuba converts to a colour."""
    table = [(float(nm), float(value)) for nm, value in zip(wavelengths, values, strict=False)]
    return {"type": "spectrum", "value": table}, "the spectrum is rendered as red, green and blue"


def regular(described: Properties) -> StandIn:
    values = numbers(described.get("values"))
    first, last = (number_of(described, f"wavelength_{end}", nm) for end, nm in (("min", 360), ("max", 830)))
    return tabulated(np.linspace(first, last, len(values)), values)


def black_body(described: Properties) -> StandIn:
    """Planck's law, in W / (m² sr nm), as in Mitsuba's spectral variants."""
    kelvin = max(number_of(described, "temperature", 5000), 100)
    nm = np.arange(360.0, 831.0, 10.0)
    h, c, k = 6.62607015e-34, 299792458.0, 1.380649e-23
    metres = nm * 1e-9
    radiance = 2e-9 * h * c**2 / metres**5 / np.expm1(h * c / (metres * k * kelvin))
    return tabulated(nm, radiance * number_of(described, "scale", 1))


FILTERS = ("bilinear", "nearest")


def valid_microfacets(described: Properties) -> StandIn | None:
    """Before version 3 there were the distributions "phong" and "as", with the width of Beckmann's for an alpha.

    The roughness of plastic could be a texture.
    """
    distribution = described.get("distribution", "beckmann")
    changes: Properties = {}
    words = []
    if distribution not in ("beckmann", "ggx"):
        changes["distribution"] = "beckmann"
        words.append(f"Beckmann's distribution instead of '{distribution}'")
    if described["type"] == "roughplastic" and isinstance(described.get("alpha"), dict):
        changes["alpha"] = DEFAULT_ALPHA
        words.append(f"a roughness of {DEFAULT_ALPHA} instead of its texture")
    metal = valid_metal(described | changes)
    if not metal and not words:
        return None
    return (metal or (described | changes, ""))[0], ", ".join([*words, *([metal[1]] if metal else [])])


def valid_metal(described: Properties) -> StandIn | None:
    """Metals are tabulated in files of Mitsuba's; "none" is a perfect mirror."""
    metal = described.get("material", "none")
    if metal == "none" or (Path(mi.__file__).parent / "data" / "ior" / f"{metal}.eta.spd").exists():
        return None
    return described | {"material": "none"}, f"this Mitsuba has no material '{metal}': a perfect mirror instead"


def valid_bitmap(described: Properties) -> StandIn | None:
    """Bitmaps of versions before 3 had other filters and edges, and a gamma; 1 is for values that are no colours."""
    if "filename" not in described:
        return GREY, "grey, because its file is not named"
    wraps = {str(described[name]) for name in ("wrap_mode", "wrap_mode_u", "wrap_mode_v") if name in described}
    wrap = next(iter(sorted(wraps & {"repeat", "mirror", "clamp"})), "clamp") if wraps else "repeat"
    gamma = described.get("gamma", -1)
    words = []
    if wraps - {wrap}:
        words.append(f"wrapped as '{wrap}'")
    if described.get("filter_type", "bilinear") not in FILTERS:
        words.append("filtered bilinearly")
    if gamma not in (-1, 1):
        words.append(f"decoded as sRGB, not with a gamma of {gamma}")
    old = ("wrap_mode_u", "wrap_mode_v", "gamma", "cache", "max_anisotropy")
    if not words and not described.keys() & {*old}:
        return None
    valid = renamed(described, **dict.fromkeys(old)) | {"type": "bitmap", "wrap_mode": wrap}
    if valid.get("filter_type") not in FILTERS:
        valid["filter_type"] = "bilinear"
    return valid | ({"raw": True} if gamma == 1 else {}), ", ".join(words)


def sampled_everywhere(described: Properties) -> StandIn | None:
    """With compensation, directions darker than the mean are left to rays, which the last vertex of a path lacks."""
    return (described | {"mis_compensation": False}, "") if described.get("mis_compensation") else None


def valid_lens(described: Properties) -> StandIn | None:
    length = described.get("focal_length", "")
    return None if isinstance(length, str) else (described | {"focal_length": f"{length}mm"}, "")


# By plugins of this Mitsuba: the stand-in if an object cannot be rendered as described, else None;
# its description is empty where that makes no difference.
REPAIRS: dict[str, Callable[[Properties], StandIn | None]] = {
    **dict.fromkeys(("bumpmap", "normalmap"), without_relief),
    # Mitsuba crashes without a volume, and without a file or values.
    "volume": lambda described: None if has_volume(described) else (GREY, "grey, because its volume is missing"),
    "bitmap": valid_bitmap,
    "conductor": valid_metal,
    **dict.fromkeys(("roughconductor", "roughdielectric", "roughplastic"), valid_microfacets),
    **dict.fromkeys(("perspective", "thinlens"), valid_lens),
    "spot": spot_without_texture,
    "envmap": sampled_everywhere,
    "shapegroup": dark_group,
    "instance": lambda described: None if nested(described) else (None, "an instance of nothing is left out"),
    # Mitsuba cannot trace a moving sun symbolically, as our path tracer does.
    "timed_sunsky": with_properties("sunsky, whose sun does not move", type="sunsky"),
    "irregular": lambda described: tabulated(numbers(described.get("wavelengths")), numbers(described.get("values"))),
    "regular": regular,
    "blackbody": black_body,
}
