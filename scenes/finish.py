"""Random materials over the range that denoisers must learn."""

from collections.abc import Callable

import numpy as np

from scenes.bsdf import Bsdf, bitmap, diffuse_bsdf, rgb
from scenes.colours import colour
from scenes.draws import Rng, log_uniform
from scenes.textures import gray_texture, texture

METALS = ("Al", "Ag", "Au", "Cu", "Cr")  # Mitsuba's names
GLASS = 1.5  # index of refraction; Mitsuba compiles it into kernels, so that rooms share one
SHEETS = ("leaf", "shade", "fabric", "print")  # thin, seen from both sides
NEVER_GLOSSY = (*SHEETS, "stem", "paper", "cushion", "blanket", "soil", "wax")
ALWAYS_GLOSSY = ("metal", "glass")
WHITENED = {"wall": 0.5, "floor": 0.1, "dark wall": 0.0}  # see paler


def reflectance(rng: Rng, textured: float, repeats: float) -> Bsdf:
    """A colour, or with probability `textured` a bitmap."""
    if rng.random() < textured:
        return bitmap(texture(rng), repeats)
    return rgb(colour(rng))


def paler(rng: Rng, base: Bsdf, white: float) -> Bsdf:
    """`base` with less colour, and up to the share `white` of the way to white.

    Large surfaces are rarely as colourful and dark as small ones.
    """
    key = "data" if base["type"] == "bitmap" else "value"
    values = np.asarray(base[key], np.float32)
    values = values + (values.mean(axis=-1, keepdims=True) - values) * np.float32(rng.uniform(0, 0.9))
    values = values + (np.float32(0.85) - values) * np.float32(rng.uniform(0, white))
    return {**base, key: values if key == "data" else values.tolist()}


def alpha(rng: Rng, base: Bsdf, low: float, high: float) -> Bsdf | float:
    """GGX roughness from `low` to `high`, in one of three cases from a texture that repeats as that of `base` does."""
    value = log_uniform(rng, low, high)
    if rng.random() < 1 / 3:
        placed = {"to_uv": base["to_uv"]} if base["type"] == "bitmap" else {}
        return bitmap(gray_texture(rng, max(low, value / 2), min(high, value * 2))) | placed
    return value


def rough_plastic_bsdf(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "roughplastic", "diffuse_reflectance": base, "alpha": log_uniform(rng, 0.03, 0.4)}


def plastic_bsdf(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "plastic", "diffuse_reflectance": base}


def principled_bsdf(rng: Rng, base: Bsdf) -> Bsdf:
    metallic = float(rng.choice([0.0, rng.uniform(), 1.0]))
    roughness = alpha(rng, base, 0.2, 0.8)  # GGX alpha is its square
    return {"type": "principled", "base_color": base, "metallic": metallic, "roughness": roughness, "specular": 0.5}


def rough_metal_bsdf(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "roughconductor", "material": str(rng.choice(METALS)), "alpha": alpha(rng, base, 0.02, 0.5)}


def mirror_bsdf(rng: Rng, base: Bsdf) -> Bsdf:
    return {"type": "conductor", "material": str(rng.choice(METALS))}


def glass_bsdf(rng: Rng, base: Bsdf) -> Bsdf:
    if rng.random() < 0.2:
        return {"type": "roughdielectric", "alpha": log_uniform(rng, 0.02, 0.2), "int_ior": GLASS}
    return {"type": "dielectric", "int_ior": GLASS}


Finish = Callable[[Rng, Bsdf], Bsdf]

# What a slot may be made of when it is not plainly diffuse, with weights.
GLOSSY: dict[str, dict[Finish, float]] = {
    "metal": {rough_metal_bsdf: 10, mirror_bsdf: 1, principled_bsdf: 4},
    "glass": {glass_bsdf: 1},
    "body": {
        rough_plastic_bsdf: 12,
        plastic_bsdf: 4,
        principled_bsdf: 12,
        rough_metal_bsdf: 10,
        mirror_bsdf: 1,
        glass_bsdf: 1,
    },
    "ceramic": {plastic_bsdf: 2, rough_plastic_bsdf: 3, principled_bsdf: 1},
    "slat": {rough_metal_bsdf: 1, rough_plastic_bsdf: 1},
    "floor": {rough_plastic_bsdf: 4, principled_bsdf: 2, plastic_bsdf: 1},
    "wall": {rough_plastic_bsdf: 1},
}
GLOSSY_OTHERWISE: dict[Finish, float] = {
    rough_plastic_bsdf: 4,
    principled_bsdf: 2,
    plastic_bsdf: 1,
    rough_metal_bsdf: 1,
}


def finish(rng: Rng, slot: str, gloss: float, size: float) -> Bsdf:
    """A material for a part of a thing of `size` metres; slots are those of ThingPart and WHITENED.

    `gloss` in [0, 1] is the share of parts that are not plainly diffuse, of those that may be glossy.
    """
    if slot == "print":  # its texture coordinates span it once
        base = reflectance(rng, 0.85, 1.0)
    else:
        base = reflectance(rng, 0.5, log_uniform(rng, 0.5, 2.0) / min(size, 1.0))
    if slot in WHITENED:
        base = paler(rng, base, WHITENED[slot])
    if slot in ALWAYS_GLOSSY or (slot not in NEVER_GLOSSY and rng.random() < gloss):
        weight_of = GLOSSY.get(slot, GLOSSY_OTHERWISE)
        weights = np.array(list(weight_of.values()))
        chosen = list(weight_of)[int(rng.choice(len(weights), p=weights / weights.sum()))]
        return chosen(rng, base)
    plain = diffuse_bsdf(base)
    return {"type": "twosided", "bsdf": plain} if slot in SHEETS else plain
