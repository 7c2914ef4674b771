"""Albedo supersampled over frames, for renderers that give it the frame's few samples at random places of the pixel.

Edges and textures of such an albedo are aliased, and so is denoised light times it. Light is divided by the albedo of
its own samples and multiplied by the mean albedo of this frame and those before, as in temporal antialiasing (Karis
2014, "High Quality Temporal Supersampling"): fetched along the motion, and clamped to what neighbours show.
"""

from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional as F

from datasets.channels import ALBEDO_FLOOR, CHANNELS
from datasets.frame import Frame, times_each
from models.operators import sampling_grid

MOST_BEFORE = 4  # frames that the mean before counts as at most: each fetch blurs it a little


class AlbedoMean:
    """The mean albedo (1, 3, H, W) of a shot so far, and the number of frames (1, 1, H, W) that it counts as."""

    def __init__(self) -> None:
        self.mean: Tensor | None = None
        self.count: Tensor | None = None

    def add(self, frame: Frame) -> Frame:
        """The next frame of the shot, with motion, with the mean albedo under the same light."""
        surface = (frame.depth > 0).to(frame.albedo)
        mean, count = frame.albedo, surface
        if self.mean is not None and self.count is not None:
            grid = sampling_grid(frame.motion)
            inside = (grid.abs() <= 1).all(dim=-1)[:, None]
            before = F.grid_sample(self.count, grid, "nearest", align_corners=False).clamp(max=MOST_BEFORE)
            count = surface * (1 + before * inside)
            fetched = F.grid_sample(self.mean, grid, "bicubic", "border", align_corners=False)
            fetched = fetched.clamp(*range_of_neighbours(frame.albedo, surface))
            mean = torch.where(count > 1, torch.lerp(fetched, frame.albedo, 1 / count.clamp(min=1)), frame.albedo)
        self.mean, self.count = mean, count
        ratio = mean.clamp(min=ALBEDO_FLOOR) / frame.albedo.clamp(min=ALBEDO_FLOOR)
        light = {name: light * ratio for name, light in frame.channels.items() if CHANNELS[name].is_reflected}
        parts = None if frame.parts is None else times_each(frame.parts, ratio)
        return replace(frame.with_channels({"albedo": mean, **light}), parts=parts)


def range_of_neighbours(albedo: Tensor, surface: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest albedo (1, 3, H, W) of surfaces among 3 x 3 pixels; of background, 0 and 1."""
    low = -F.max_pool2d(torch.where(surface > 0, -albedo, -1.0), 3, 1, 1)
    high = F.max_pool2d(torch.where(surface > 0, albedo, 0.0), 3, 1, 1)
    return torch.where(low > high, 0.0, low), torch.where(low > high, 1.0, high)
