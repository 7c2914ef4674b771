"""Random materials."""

from collections.abc import Callable

import numpy as np

from scenes.colours import Bsdf, bitmap, colour, diffuse_bsdf, rgb
from scenes.draws import Rng, log_uniform
from scenes.textures import gray_texture, texture

METALS = ("Al", "Ag", "Au", "Cu", "Cr")  # Mitsuba's names
GLASS = 1.5  # index of refraction; Mitsuba compiles it into kernels, so that rooms share one
CLEAR_GLASS: Bsdf = {"type": "dielectric", "int_ior": GLASS}
SHEETS = ("leaf", "shade", "fabric", "print")  # thin, two-sided
NEVER_GLOSSY = (*SHEETS, "stem", "paper", "cushion", "blanket", "soil", "wax")
ALWAYS_GLOSSY = ("metal", "glass", "clear", "mirror")
WHITENED = {"wall": 0.5, "floor": 0.1, "dark wall": 0.0}  # up to this share of white is added


def alpha(rng: Rng, base: Bsdf, low: float, high: float) -> Bsdf | float:
    """GGX alpha from `low` to `high`, in one of three cases from a texture placed as that of `base`."""
    value = log_uniform(rng, low, high)
    if rng.random() < 1 / 3:
        placed = {"to_uv": base["to_uv"]} if base["type"] == "bitmap" else {}
        return bitmap(gray_texture(rng, max(low, value / 2), min(high, value * 2))) | placed
    return value


def principled_bsdf(rng: Rng, base: Bsdf) -> Bsdf:
    metallic = float(rng.choice([0.0, rng.uniform(), 1.0]))
    roughness = alpha(rng, base, 0.2, 0.8)  # GGX alpha is its square
    return {"type": "principled", "base_color": base, "metallic": metallic, "roughness": roughness, "specular": 0.5}


FINISHES: dict[str, Callable[[Rng, Bsdf], Bsdf]] = {
    "rough plastic": lambda rng, base: (
        {"type": "roughplastic", "diffuse_reflectance": base, "alpha": log_uniform(rng, 0.03, 0.4)}
    ),
    "plastic": lambda rng, base: {"type": "plastic", "diffuse_reflectance": base},
    "principled": principled_bsdf,
    "rough metal": lambda rng, base: (
        {"type": "roughconductor", "material": str(rng.choice(METALS)), "alpha": alpha(rng, base, 0.02, 0.5)}
    ),
    "mirror": lambda rng, base: {"type": "conductor", "material": str(rng.choice(METALS))},
    "glass": lambda rng, base: (
        {"type": "roughdielectric", "alpha": log_uniform(rng, 0.02, 0.2), "int_ior": GLASS}
        if rng.random() < 0.2
        else CLEAR_GLASS
    ),
    "clear": lambda rng, base: CLEAR_GLASS,
}
# Weights of the finishes of a slot that is not plainly diffuse.
GLOSSY_FINISHES = {
    "metal": {"rough metal": 10, "mirror": 1, "principled": 4},
    "glass": {"glass": 1},
    "clear": {"clear": 1},
    "mirror": {"mirror": 1},
    "body": {"rough plastic": 12, "plastic": 4, "principled": 12, "rough metal": 10, "mirror": 1, "glass": 1},
    "ceramic": {"plastic": 2, "rough plastic": 3, "principled": 1},
    "slat": {"rough metal": 1, "rough plastic": 1},
    "floor": {"rough plastic": 4, "principled": 2, "plastic": 1},
    "wall": {"rough plastic": 1},
}
OTHER_GLOSSY = {"rough plastic": 4, "principled": 2, "plastic": 1, "rough metal": 1}


def finish(rng: Rng, slot: str, gloss: float, size: float) -> Bsdf:
    """A material for a part of a thing of `size` metres; slots are those of Thing and WHITENED.

    `gloss` in [0, 1] is the share of parts that are not plainly diffuse, of those that may be glossy.
    """
    is_print = slot == "print"  # its texture coordinates are 0..1
    repeats = 1.0 if is_print else log_uniform(rng, 0.5, 2.0) / min(size, 1.0)
    is_textured = rng.random() < (0.85 if is_print else 0.5)
    values = np.asarray(texture(rng) if is_textured else colour(rng))
    if slot in WHITENED:  # less saturated and whiter, as is typical of large surfaces
        values = values.astype(np.float32)
        values = values + (values.mean(axis=-1, keepdims=True) - values) * np.float32(rng.uniform(0, 0.9))
        values = values + (np.float32(0.85) - values) * np.float32(rng.uniform(0, WHITENED[slot]))
    base = bitmap(values, repeats) if is_textured else rgb(values.tolist())
    if slot in ALWAYS_GLOSSY or (slot not in NEVER_GLOSSY and rng.random() < gloss):
        weight_of = GLOSSY_FINISHES.get(slot, OTHER_GLOSSY)
        weights = np.array(list(weight_of.values()))
        chosen = rng.choice(list(weight_of), p=weights / weights.sum())
        return FINISHES[str(chosen)](rng, base)
    plain = diffuse_bsdf(base)
    return {"type": "twosided", "bsdf": plain} if slot in SHEETS else plain
