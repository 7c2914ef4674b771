"""Random materials, as Mitsuba dictionaries, over the range that denoisers must learn."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.textures import colour, gray_texture, texture

Bsdf = dict[str, Any]
Rng = np.random.Generator

METALS = ("Al", "Ag", "Au", "Cu", "Cr")
SHEETS = ("leaf", "shade", "fabric", "print")  # thin, seen from both sides
MATT = (*SHEETS, "stem", "paper", "cushion", "blanket", "soil", "wax")  # never glossy


def bitmap(values: NDArray[np.float32], repeats: float = 1.0) -> Bsdf:
    """A texture of linear `values` (H, W, C), `repeats` times in a unit of texture coordinates."""
    return {"type": "bitmap", "data": values, "raw": True, "to_uv": np.diag([repeats, repeats, 1.0])}


def log_uniform(rng: Rng, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def reflectance(rng: Rng, textured: float, repeats: float) -> Bsdf:
    """A colour, or with probability `textured` a bitmap."""
    if rng.random() < textured:
        return bitmap(texture(rng), repeats)
    return {"type": "rgb", "value": list(colour(rng))}


def paler(rng: Rng, base: Bsdf, white: float) -> Bsdf:
    """Large surfaces are rarely as colourful and dark as small ones: up to the share `white` of the way to white."""
    key = "data" if base["type"] == "bitmap" else "value"
    values = np.asarray(base[key], np.float32)
    values = values + (values.mean(axis=-1, keepdims=True) - values) * np.float32(rng.uniform(0, 0.9))
    values = values + (np.float32(0.85) - values) * np.float32(rng.uniform(0, white))
    return {**base, key: values if key == "data" else values.tolist()}


def alpha(rng: Rng, low: float, high: float) -> Bsdf | float:
    """GGX roughness, one in three from a texture."""
    value = log_uniform(rng, low, high)
    if rng.random() < 1 / 3:
        return bitmap(gray_texture(rng, max(low, value / 2), min(high, value * 2)), log_uniform(rng, 0.5, 3.0))
    return value


def diffuse(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "diffuse", "reflectance": base}


def rough_plastic(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "roughplastic", "diffuse_reflectance": base, "alpha": log_uniform(rng, 0.03, 0.4)}


def plastic(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "plastic", "diffuse_reflectance": base}


def principled(rng: Rng, base: Bsdf) -> Bsdf:
    metallic = float(rng.choice([0.0, rng.uniform(), 1.0]))
    roughness = alpha(rng, 0.2, 0.8)  # alpha is its square
    return {"type": "principled", "base_color": base, "metallic": metallic, "roughness": roughness, "specular": 0.5}


def rough_metal(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "roughconductor", "material": str(rng.choice(METALS)), "alpha": alpha(rng, 0.02, 0.5)}


def mirror(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "conductor", "material": str(rng.choice(METALS))}


def glass(rng: Rng, base: Bsdf) -> Bsdf:
    if rng.random() < 0.2:
        return {"type": "roughdielectric", "alpha": log_uniform(rng, 0.02, 0.2), "int_ior": rng.uniform(1.3, 1.7)}
    return {"type": "dielectric", "int_ior": rng.uniform(1.3, 1.7)}


Finish = Callable[[Rng, Bsdf], Bsdf]

# What a slot may be made of when it is not plainly diffuse, with weights.
GLOSSY: dict[str, dict[Finish, float]] = {
    "metal": {rough_metal: 10, mirror: 1, principled: 4},
    "glass": {glass: 1},
    "body": {rough_plastic: 12, plastic: 4, principled: 12, rough_metal: 10, mirror: 1, glass: 1},
    "ceramic": {plastic: 2, rough_plastic: 3, principled: 1},
    "slat": {rough_metal: 1, rough_plastic: 1},
    "floor": {rough_plastic: 4, principled: 2, plastic: 1},
    "wall": {rough_plastic: 1},
}
ELSE: dict[Finish, float] = {rough_plastic: 4, principled: 2, plastic: 1, rough_metal: 1}
ALWAYS = ("metal", "glass")
WHITENED = {"wall": 0.5, "floor": 0.1, "dark wall": 0.0}


def finish(rng: Rng, slot: str, gloss: float, size: float) -> Bsdf:
    """A material for a part, named as in scenes.objects or WHITENED, of a thing of `size` metres.

    `gloss` in [0, 1] is the share of parts that are not plainly diffuse, of those that may be glossy.
    """
    if slot == "print":  # its texture coordinates span it once
        base = reflectance(rng, 0.85, 1.0)
    else:
        base = reflectance(rng, 0.5, log_uniform(rng, 0.5, 2.0) / min(size, 1.0))
    if slot in WHITENED:
        base = paler(rng, base, WHITENED[slot])
    if slot in ALWAYS or (slot not in MATT and rng.random() < gloss):
        kinds = GLOSSY.get(slot, ELSE)
        weights = np.array(list(kinds.values()))
        return list(kinds)[int(rng.choice(len(kinds), p=weights / weights.sum()))](rng, base)
    plain = diffuse(rng, base)
    return {"type": "twosided", "bsdf": plain} if slot in SHEETS else plain
