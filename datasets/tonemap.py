"""Exposure and the display transform, for metrics and pictures only: they are no inputs of networks."""

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from datasets.channels import LUMINANCE_WEIGHTS

DISPLAY_GAMMA = 2.2

ArrayOrTensor = TypeVar("ArrayOrTensor", bound=Any)


def luminance(radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    """Luminance (...,) of linear RGB (..., 3), by ITU-R BT.709; of tensors: models.operators.image_luminance."""
    return radiance @ np.array(LUMINANCE_WEIGHTS)


def clip_exposure(y: NDArray[np.floating]) -> float:
    """The exposure of a clip, from the luminance of direct + indirect light in its reference: all frames, any shape.

    min(0.18 / exp(mean ln max(Y, 1e-4 mean Y)), 1 / P95(Y)): the geometric mean becomes middle grey, unless that
    clipped more than 5 % of the pixels. It is 1 where everything is black.
    """
    y = y.astype(np.float64)
    mean = y.mean()
    if mean <= 0:
        return 1.0
    exposure = 0.18 / np.exp(np.log(np.maximum(y, 1e-4 * mean)).mean())
    percentile = np.percentile(y, 95)
    return float(min(exposure, 1 / percentile) if percentile > 0 else exposure)


def display(radiance: ArrayOrTensor, exposure: float) -> ArrayOrTensor:
    """clip(exposure * radiance, 0, 1)^(1/2.2), in [0, 1], as an array or a tensor of the same shape."""
    exposed: Any = exposure * radiance
    return exposed.clip(0, 1) ** (1 / DISPLAY_GAMMA)


def to_8_bits(image: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Values in [0, 1], rounded to bytes."""
    return (255 * image + 0.5).astype(np.uint8)


def noise_of_mean(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Expected squared error of the mean of two independent images, as displayed: mean((a - b)^2) / 4."""
    return float(((a - b) ** 2).mean() / 4)


def psnr(mse: float) -> float:
    """Peak signal-to-noise ratio in dB of signals in [0, 1]: min(100, -10 log10 mse)."""
    return min(100.0, -10 * math.log10(mse)) if mse > 0 else 100.0
