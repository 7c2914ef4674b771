"""Exposure and the display transform, for metrics and pictures only: networks never see them."""

import math
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from datasets.channels import LUMINANCE_WEIGHTS

Image = TypeVar("Image", bound=Any)


def luminance(radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    """Rec. 709 luminance (...,) of linear RGB (..., 3)."""
    return radiance @ np.array(LUMINANCE_WEIGHTS)


def clip_exposure(y: NDArray[np.floating]) -> float:
    """Exposure of a clip from the luminance of its reference's direct + indirect, all frames, any shape.

    min(0.18 / exp(mean ln max(Y, 1e-4 mean Y)), 1 / P95(Y)): middle grey for the geometric mean, but at most 5 % of the
    pixels clipped. 1 where everything is black.
    """
    y = y.astype(np.float64)
    mean = y.mean()
    if mean <= 0:
        return 1.0
    exposure = 0.18 / np.exp(np.log(np.maximum(y, 1e-4 * mean)).mean())
    percentile = np.percentile(y, 95)
    return float(min(exposure, 1 / percentile) if percentile > 0 else exposure)


def display(radiance: Image, exposure: float) -> Image:
    """clip(exposure * radiance, 0, 1)^(1/2.2), in [0, 1], of a numpy array or a tensor."""
    exposed: Any = exposure * radiance
    return exposed.clip(0, 1) ** (1 / 2.2)


def noise_of_halves(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Squared error of the mean of two independent images as displayed: mean((a - b)^2) / 4."""
    return float(((a - b) ** 2).mean() / 4)


def psnr(mse: float) -> float:
    """min(100, -10 log10 mse) in dB, for signals in [0, 1]."""
    return min(100.0, -10 * math.log10(mse)) if mse > 0 else 100.0
