"""Colours, from the sRGB curve to random lamps, and materials of one colour or texture as Mitsuba dictionaries."""

import colorsys
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.camera import Array
from scenes.draws import Rng

Bsdf = dict[str, Any]  # or a texture within one; the values of a bitmap are a numpy array under "data"

MIN_REFLECTANCE = 0.02  # linear
MAX_REFLECTANCE = 0.9

# From candlelight to daylight in the shade.
LIGHT_COLOURS = np.array([[1.0, 0.55, 0.25], [1.0, 0.75, 0.5], [1.0, 0.95, 0.85], [0.8, 0.9, 1.0]])
COLOURED_LAMPS = 0.03  # share of lamps of any hue


def srgb_to_linear(encoded: Array) -> Array:
    """Linear values of sRGB values in [0, 1] (IEC 61966-2-1)."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def hsv(hue: float, saturation: float, value: float) -> Array:
    """Linear reflectance (3,) of a displayed colour (gamma 2.2); the hue wraps, the rest is clipped to [0, 1]."""
    rgb = colorsys.hsv_to_rgb(hue % 1, float(np.clip(saturation, 0, 1)), float(np.clip(value, 0, 1)))
    return np.clip(np.array(rgb) ** 2.2, MIN_REFLECTANCE, MAX_REFLECTANCE)


def hue_saturation_value(rng: Rng) -> tuple[float, float, float]:
    """A displayed colour typical of interiors: white, grey, dark, wood, muted or saturated."""
    hue = rng.uniform()
    earth = rng.normal(0.08, 0.025)
    kinds = (  # share, hue, saturation, value
        (0.22, earth, rng.uniform(0, 0.12), rng.uniform(0.8, 0.96)),
        (0.13, hue, rng.uniform(0, 0.08), rng.uniform(0.3, 0.8)),
        (0.10, hue, rng.uniform(0, 0.4), rng.uniform(0.05, 0.25)),
        (0.20, earth, rng.uniform(0.25, 0.7), rng.uniform(0.25, 0.8)),
        (0.25, hue, rng.uniform(0.1, 0.4), rng.uniform(0.35, 0.85)),
        (0.10, hue, rng.uniform(0.55, 0.95), rng.uniform(0.4, 0.95)),
    )
    _, hue, saturation, value = kinds[rng.choice(len(kinds), p=[kind[0] for kind in kinds])]
    return hue, saturation, value


def colour(rng: Rng) -> list[float]:
    """A plausible reflectance, linear RGB."""
    return hsv(*hue_saturation_value(rng)).tolist()


def palette(rng: Rng, count: int) -> Array:
    """Linear reflectances (count, 3): unrelated, of one hue, or of one hue with an accent."""
    kind = rng.integers(4)
    if kind == 0:
        return np.array([colour(rng) for _ in range(count)])
    hue, saturation, value = hue_saturation_value(rng)
    values = value + rng.uniform(0.03, 0.4) * rng.permutation(np.linspace(-1, 1, count))
    hues = hue + rng.normal(0, 0.04, count)
    saturations = saturation * rng.uniform(0.7, 1.3, count)
    colours = np.array([*map(hsv, hues, saturations, np.clip(values, 0.08, 1))])
    if kind == 1:
        colours[rng.integers(count)] = hsv(rng.uniform(), rng.uniform(0.5, 1), rng.uniform(0.4, 0.95))
    return colours


def light_colour(rng: Rng) -> Array:
    """A lamp's colour (3,) with maximum 1: nearly white, sometimes of candles, rarely of any hue."""
    if rng.random() < COLOURED_LAMPS:
        hue = rng.dirichlet(np.ones(3))
        return np.asarray(hue / hue.max())
    position = (len(LIGHT_COLOURS) - 1) * rng.beta(3, 2)
    colour = np.stack([np.interp(position, range(len(LIGHT_COLOURS)), channel) for channel in LIGHT_COLOURS.T])
    return np.asarray(colour / colour.max())


def rgb(values: Iterable[float]) -> Bsdf:
    """A constant colour: linear RGB, 0..1."""
    return {"type": "rgb", "value": list(values)}


def bitmap(values: NDArray[np.float32], repeats: float = 1.0) -> Bsdf:
    """A texture of linear `values` (H, W, C), `repeats` times in a unit of texture coordinates."""
    return {"type": "bitmap", "data": values, "raw": True, "to_uv": np.diag([repeats, repeats, 1.0])}


def diffuse_bsdf(reflectance: Bsdf) -> Bsdf:
    """A Lambertian surface of that colour or texture."""
    return {"type": "diffuse", "reflectance": reflectance}
