"""Mirrors in the input of denoisers: what a mirror shows, as if it stood behind the mirror."""

from collections.abc import Callable, Container
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.channels import CHANNELS, MIRRORED


def visible(name: str, stored: Container[str], read: Callable[[str], NDArray[Any]]) -> NDArray[Any]:
    """A channel (..., H, W, C), in mirrors of the surfaces that these show, if the `stored` channels describe them.

    All motion in a mirror is that of what the mirror shows. The renderer's gradient is of the mirror itself: there it
    counts as 0.
    """
    if MIRRORED.get(name) in stored:
        return read(MIRRORED[name])
    own = read(name)
    if not CHANNELS[name].is_temporal or MIRRORED["motion"] not in stored:
        return own
    in_mirror = read(MIRRORED["depth"]) != read("depth")
    return np.where(in_mirror, 0 if CHANNELS[name].kind == "gradient" else read(MIRRORED["motion"]), own)
