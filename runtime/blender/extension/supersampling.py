"""Albedo supersampled over frames.

Cycles gives each pixel as many samples of the albedo as of light, at random places of the pixel: at 1 spp, edges and
textures are aliased, and denoised light times such an albedo is, too. Light is divided by the albedo of its own samples
and multiplied by the mean albedo of this frame and those before, as temporal antialiasing would have it (Karis, "High
Quality Temporal Supersampling", 2014): fetched along motion vectors, and clamped to what the pixel's neighbours show.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from .cycles_frame import CyclesFrame, Image
from .exr import in_parallel

ALBEDO_FLOOR = 0.01  # of onespp.c: light is divided by no less
MOST_BEFORE = 4  # frames that the mean before counts as at most: each fetch blurs it a little
STRIP = 64  # rows


@dataclass(frozen=True)
class AlbedoMean:
    """Mean albedo (H, W, 3) and how many frames it counts as (H, W); no more than 1 at background."""

    mean: Image
    frames: Image

    @staticmethod
    def begin(frame: CyclesFrame) -> "AlbedoMean":
        return AlbedoMean(frame.albedo, surfaces(frame))

    def add(self, frame: CyclesFrame) -> "AlbedoMean":
        """The mean with the next frame, seen from there."""
        least, most = range_of_neighbours(frame)
        strips = [slice(top, top + STRIP) for top in range(0, frame.size[0], STRIP)]
        parts = in_parallel(partial(self.add_strip, frame, least, most), strips)
        mean, frames = (np.concatenate(each) for each in zip(*parts, strict=True))
        return AlbedoMean(mean, frames)

    def add_strip(self, frame: CyclesFrame, least: Image, most: Image, rows: slice) -> tuple[Image, Image]:
        height, width = self.frames.shape
        y, x = np.mgrid[:height, :width].astype(np.float32)[:, rows]
        motion = np.nan_to_num(frame.motion[rows])
        x, y = x + motion[..., 0], y + motion[..., 1]
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        x, y = np.where(inside, x, 0), np.where(inside, y, 0)
        before = self.frames[np.rint(y).astype(np.intp), np.rint(x).astype(np.intp)].clip(max=MOST_BEFORE)
        frames = surfaces(frame)[rows] * (1 + before * inside)
        albedo = frame.albedo[rows]
        mean = catmull_rom(self.mean, x, y).clip(least[rows], most[rows])
        mean += (albedo - mean) / np.maximum(frames, 1)[..., None]
        return np.where(frames[..., None] > 1, mean, albedo), frames


def surfaces(frame: CyclesFrame) -> Image:
    """1 where a pixel (H, W) shows a surface, else 0."""
    return (frame.depth[..., 0] > 0).astype(np.float32)


def range_of_neighbours(frame: CyclesFrame) -> tuple[Image, Image]:
    """The least and the largest albedo (H, W, 3) of surfaces among 3 x 3 pixels; 0 and 1 without any."""
    is_surface = frame.depth > 0
    low, high = (np.where(is_surface, frame.albedo, extreme) for extreme in (np.float32(1), np.float32(0)))
    for axis in (0, 1):
        low, high = extreme_of_three(np.minimum, low, axis), extreme_of_three(np.maximum, high, axis)
    empty = low > high
    return np.where(empty, 0, low), np.where(empty, 1, high)


def extreme_of_three(extreme: np.ufunc, image: Image, axis: int) -> Image:
    """The extreme of each pixel and its two neighbours along an axis."""
    result = image.copy()
    here, there = np.moveaxis(result, axis, 0), np.moveaxis(image, axis, 0)
    extreme(here[1:], there[:-1], out=here[1:])
    extreme(here[:-1], there[1:], out=here[:-1])
    return result


def catmull_rom(image: Image, x: Image, y: Image) -> Image:
    """Values (..., C) of an image (H, W, C) at columns x and rows y, by the cubic convolution of Keys (1981), a = -1/2.

    Bilinear weights would blur the mean more with each frame.
    """
    height, width = image.shape[:2]
    left, top = np.floor(x), np.floor(y)
    across, down = cubic_weights(x - left), cubic_weights(y - top)
    columns = [(left.astype(np.intp) + step).clip(0, width - 1) for step in range(-1, 3)]
    rows = [(top.astype(np.intp) + step).clip(0, height - 1) for step in range(-1, 3)]
    result = np.zeros((*x.shape, image.shape[2]), np.float32)
    for row, weight_y in zip(rows, down, strict=True):
        for column, weight_x in zip(columns, across, strict=True):
            result += image[row, column] * (weight_x * weight_y)[..., None]
    return result


def cubic_weights(t: Image) -> tuple[NDArray[np.floating], ...]:
    """Of the pixels at -1, 0, 1 and 2, for a place t in [0, 1)."""
    t2, t3 = t * t, t * t * t
    return (-t3 + 2 * t2 - t) / 2, (3 * t3 - 5 * t2 + 2) / 2, (-3 * t3 + 4 * t2 + t) / 2, (t3 - t2) / 2


def with_albedo(frame: CyclesFrame, albedo: Image) -> CyclesFrame:
    """The frame with another albedo under the same light."""
    ratio = np.maximum(albedo, ALBEDO_FLOOR) / np.maximum(frame.albedo, ALBEDO_FLOOR)
    return replace(frame, color=(frame.color * ratio).astype(np.float32), albedo=albedo)
