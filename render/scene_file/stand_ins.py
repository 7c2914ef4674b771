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


def mixture(described: Properties) -> StandIn:
    """Two at a time, as blendbsdf mixes them."""
    inner = [value for value in nested(described) if value["type"] in plugins()]
    weights = [float(w) for w in str(described.get("weights", "")).replace(",", " ").split()]
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
