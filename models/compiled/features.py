"""The inputs of models.wskp's networks for the processor, in one pass and in the order that convolutions like."""

from collections.abc import Sequence
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from models.compiled import array, threads
from models.compiled.exponential import exp, log

DARKEST = np.float32(1e-30)  # whose power is 0 as far as a network can tell, and whose logarithm is finite
jit = numba.njit(cache=True, fastmath={"contract", "nsz", "arcp"}, error_model="numpy", boundscheck=False)


@jit
def feature_row(out: Any, irradiance: Any, albedo: Any, normal: Any, depth: Any, gain: Any, scale: Any) -> None:
    """out (W, 10) from irradiance, albedo and normal (3, W) and depth (W)."""
    floor, power = scale[1], scale[2]
    line = np.empty(depth.size, np.float32)
    for c in range(3):
        for x in range(line.size):
            exposed = gain[c] * irradiance[c, x] * max(albedo[c, x], floor)
            line[x] = exp(power * log(min(max(exposed, DARKEST), np.float32(1))))
        for x in range(line.size):
            out[x, c] = line[x]
            out[x, 3 + c] = albedo[c, x]
            out[x, 6 + c] = normal[c, x] * np.float32(0.5) + np.float32(0.5)
    for x in range(line.size):
        out[x, 9] = depth[x] / (depth[x] + scale[0]) if depth[x] > 0 else np.float32(1)


@numba.njit(cache=True, parallel=True, error_model="numpy")
def feature_image(out: Any, irradiance: Any, albedo: Any, normal: Any, depth: Any, gain: Any, scale: Any) -> None:
    for y in numba.prange(depth.shape[0]):
        feature_row(out[y], irradiance[:, y], albedo[:, y], normal[:, y], depth[y], gain, scale)


def features(images: Sequence[Tensor], gain: NDArray[np.floating[Any]], scale: NDArray[np.floating[Any]]) -> Tensor:
    """Displayed colour, albedo, normal in [0, 1] and d / (d + s): (10, H, W), channels last in memory.

    Args:
        images: irradiance, albedo, normal (3, H, W) and depth (1, H, W). gain: (3,), what radiance is multiplied by.
        scale: (3,), the depth s, the least albedo of re-modulation, and the exponent of the display transform.
    """
    threads()
    irradiance, albedo, normal, depth = (array(image) for image in images)
    out = torch.empty(*depth.shape[1:], 10)
    constants = gain.astype(np.float32), scale.astype(np.float32)
    feature_image(out.numpy(), irradiance, albedo, normal, depth[0], *constants)
    return out.permute(2, 0, 1)
