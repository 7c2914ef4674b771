"""Materials as Mitsuba dictionaries; the values of a bitmap are a numpy array under "data"."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bsdf = dict[str, Any]  # or a texture within one


def rgb(values: Iterable[float]) -> Bsdf:
    """A constant colour: linear RGB, 0..1."""
    return {"type": "rgb", "value": list(values)}


def bitmap(values: NDArray[np.float32], repeats: float = 1.0) -> Bsdf:
    """A texture of linear `values` (H, W, C), `repeats` times in a unit of texture coordinates."""
    return {"type": "bitmap", "data": values, "raw": True, "to_uv": np.diag([repeats, repeats, 1.0])}


def diffuse_bsdf(reflectance: Bsdf) -> Bsdf:
    """A Lambertian surface of that colour or texture."""
    return {"type": "diffuse", "reflectance": reflectance}
