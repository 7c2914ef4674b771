"""What denoisers see of mirrors: what stands in them, as if it stood behind them."""

from collections.abc import Callable, Container
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.channels import CHANNELS, MIRRORED


def seen(name: str, stored: Container[str], read: Callable[[str], NDArray[Any]]) -> NDArray[Any]:
    """A channel (..., H, W, C) of which `stored` are there to `read`: of what mirrors show, where that is stored.

    Whatever else moves in a pixel of a mirror, its motion is that of what the mirror shows; and how light changes there
    the renderer has only told of the mirror itself, so that the gradient is 0.
    """
    if MIRRORED.get(name) in stored:
        return read(MIRRORED[name])
    own = read(name)
    if not CHANNELS[name].is_temporal or MIRRORED["motion"] not in stored:
        return own
    in_mirror = read(MIRRORED["depth"]) != read("depth")
    return np.where(in_mirror, 0 if name == "gradient" else read(MIRRORED["motion"]), own)
