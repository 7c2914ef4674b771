"""Changes of a frame: of its light, its surfaces, its units, or one pixel."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from datasets.cameras import Cameras
from datasets.channels import CHANNELS, LENGTH, channels_of
from datasets.frame import Frame

FrameChange = Callable[[Frame], Frame]

LIGHT_CHANNELS = channels_of("noisy", "buffers", "emission")
SURFACE_CHANNELS = channels_of("surface", "motion", "hit")
LENGTHS = tuple(name for name in SURFACE_CHANNELS if CHANNELS[name].unit == LENGTH)


def unchanged(frame: Frame) -> Frame:
    return frame


def light_times(factor: float) -> FrameChange:
    """Multiply all light by `factor`."""
    return lambda frame: replace(
        frame, channels=frame.channels | {name: factor * frame.channels[name] for name in LIGHT_CHANNELS}
    )


def channels_at(**values: float | tuple[float, ...]) -> FrameChange:
    """Set channels to a constant; a tuple has one value per component."""

    def change(frame: Frame) -> Frame:
        tensors = {name: torch.zeros_like(frame.channels[name]) for name in values}
        for name, value in values.items():
            tensors[name] += torch.tensor(value).view(-1, 1, 1)
        return replace(frame, channels=frame.channels | tensors)

    return change


def ramp(frame: Frame, low: float, high: float) -> Tensor:
    """(W,) values from `low` at the left to `high` at the right, evenly spaced in the logarithm."""
    return torch.logspace(math.log10(low), math.log10(high), frame.size[1])


def dim_to_bright(frame: Frame) -> Frame:
    """Irradiance from 1e-7 to 6e4 across the image."""
    factors = ramp(frame, 1e-7, 6e4)
    return replace(frame, channels=frame.channels | {name: frame.channels[name] * factors for name in LIGHT_CHANNELS})


def near_to_far(frame: Frame) -> Frame:
    """Depth from 1e-4 to 1e6 across the image, without changing the cameras: reprojection meets other depths."""
    depth = torch.where(frame.depth > 0, ramp(frame, 1e-4, 1e6), 0)
    return replace(frame, channels=frame.channels | {"depth": depth})


def lengths_times(factor: float) -> FrameChange:
    """Change units of length: multiply depth and the positions of cameras and meshes by `factor`."""

    def cameras(at: Cameras) -> Cameras:
        factors = torch.ones(4, 4, dtype=torch.float64)
        factors[:3, 3] = factor
        return Cameras(at.K, at.camera_to_world * factors, at.object_to_world * factors)

    def change(frame: Frame) -> Frame:
        lengths = {name: factor * frame.channels[name] for name in LENGTHS}
        return replace(
            frame, channels=frame.channels | lengths, now=cameras(frame.now), previous=cameras(frame.previous)
        )

    return change


@dataclass(frozen=True)
class PixelChange:
    """Set the pixel in the middle of the image to `value`, in all components of the named channels."""

    value: float
    channels: tuple[str, ...]

    def __call__(self, frame: Frame) -> Frame:
        height, width = frame.size
        tensors = {name: frame.channels[name].clone() for name in self.channels}
        for tensor in tensors.values():
            tensor[..., height // 2, width // 2] = self.value
        return replace(frame, channels=frame.channels | tensors)
