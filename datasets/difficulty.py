"""How hard the light of a clip is to reconstruct from one sample per pixel."""

import math
from typing import NamedTuple

import numpy as np

from datasets.channels import ALBEDO_FLOOR
from datasets.clip import Clip
from datasets.tonemap import luminance

MAX_MEASURED_FRAMES = 8  # spread evenly over a clip


class Difficulty(NamedTuple):
    """Measures of the luminance of irradiance on surfaces."""

    zeros: float  # share of pixels that are exactly black at 1 spp
    relative_mse: float  # mean((x - r)^2) / mean(r)^2 of 1 spp x against the reference r
    peak: float  # 99.9th percentile of 1 spp over its mean
    contrast: float  # 95th over 5th percentile of the reference; infinite where a twentieth is black


class Measure(NamedTuple):
    head: str  # of its column in tables
    title: str  # of its histogram
    minimum: float  # of the histogram's axis; smaller values are shown there


MEASURES = {  # by field of Difficulty
    "zeros": Measure("zeros", "share of black pixels at 1 spp", 1e-3),
    "relative_mse": Measure("rel. MSE", "relative MSE at 1 spp", 1e-2),
    "peak": Measure("P99.9/mean", "P99.9 over mean at 1 spp", 1.0),
    "contrast": Measure("P95/P5", "P95 over P5 of the reference", 1.0),
}


def difficulty_of_clip(clip: Clip) -> Difficulty:
    """The mean over up to MAX_MEASURED_FRAMES frames of a clip, in its first noise realisation.

    Measures are NaN where a frame shows no surface, or none that is lit.
    """
    frames = np.unique(np.linspace(0, clip.frames - 1, MAX_MEASURED_FRAMES).round().astype(int))
    with np.errstate(divide="ignore", invalid="ignore"):
        measured = [difficulty_of_frame(clip, int(frame)) for frame in frames]
    return Difficulty(*np.mean(measured, axis=0))


def difficulty_of_frame(clip: Clip, frame: int) -> Difficulty:
    albedo = np.maximum(clip.read("albedo", frame).astype(np.float64), ALBEDO_FLOOR)
    surface = clip.read("mesh_id", frame)[..., 0] > 0
    if not surface.any():
        return Difficulty(*[math.nan] * len(MEASURES))
    light = clip.read("direct", frame).astype(np.float64) + clip.read("indirect", frame)
    buffers = clip.read("direct_reference", frame).astype(np.float64) + clip.read("indirect_reference", frame)
    noisy = luminance(light / albedo)[surface]
    reference = luminance(buffers / albedo).mean(axis=0)[surface]
    low, high = np.percentile(reference, [5, 95])
    return Difficulty(
        zeros=float((noisy == 0).mean()),
        relative_mse=float(((noisy - reference) ** 2).mean() / reference.mean() ** 2),
        peak=float(np.percentile(noisy, 99.9) / noisy.mean()),
        contrast=float(high / low),
    )
