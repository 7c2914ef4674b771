"""The stress cases, as data: how each changes a moving scene under light of irradiance 1, or the denoiser."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from datasets.cameras import Cameras
from datasets.channels import CHANNELS, LENGTH, MOTION_CHANNELS, NOISY_CHANNELS, SAMPLE_BUFFERS, channels_of
from datasets.frame import Frame, to_image, to_tensor
from eval.bench.denoisers import Size
from eval.bench.synthetic_frames import HIT_DIRECT, HIT_INDIRECT, noisy, split_into_buffers, synthetic_frame

CASE_SIZE: Size = (32, 48)
CASE_FRAMES = 10
EVEN_FRAMES = 4  # of these, at the start
SPOILED_FRAME = 2  # index of the frame with a bad pixel
RECOVERY_LIMIT = 60  # frames after it: a second or two
LIGHT_SHARES = {"direct": 0.7, "indirect": 0.3}  # of the irradiance
HIT_SHARES = {"direct": HIT_DIRECT, "indirect": HIT_INDIRECT}  # of the pixels whose one sample finds light
NOISE_PERIOD = 100  # frames until the noise of a long sequence repeats

FrameChange = Callable[[Frame], Frame]

LIGHT_CHANNELS = channels_of("noisy", "buffers", "emission")
SURFACE_CHANNELS = channels_of("surface", "motion", "hit")
LENGTHS = tuple(name for name in SURFACE_CHANNELS if CHANNELS[name].unit == LENGTH)


def as_is(frame: Frame) -> Frame:
    return frame


def scaled(frame: Frame, names: Sequence[str], factor: float | Tensor) -> Frame:
    """The frame with the named channels times `factor`, a number or one for each column (W,)."""
    return frame.with_channels({name: factor * frame.channels[name] for name in names})


def light_times(factor: float) -> FrameChange:
    return lambda frame: scaled(frame, LIGHT_CHANNELS, factor)


def channels_at(**values: float | tuple[float, ...]) -> FrameChange:
    """Set channels to a constant; a tuple has one value per component."""

    def change(frame: Frame) -> Frame:
        constants = {name: torch.tensor(value).view(-1, 1, 1) for name, value in values.items()}
        return frame.with_channels({name: torch.zeros_like(frame.channels[name]) + constants[name] for name in values})

    return change


def ramp(frame: Frame, low: float, high: float) -> Tensor:
    """(W,) values from `low` at the left to `high` at the right, evenly spaced in the logarithm."""
    return torch.logspace(math.log10(low), math.log10(high), frame.size[1])


def near_to_far(frame: Frame) -> Frame:
    """Depth from 1e-4 to 1e6 across the image, without changing the cameras: reprojection meets other depths."""
    return frame.with_channels({"depth": torch.where(frame.depth > 0, ramp(frame, 1e-4, 1e6), 0)})


def lengths_times(factor: float) -> FrameChange:
    """Change units of length: multiply depth and the positions of cameras and meshes by `factor`."""

    def cameras(at: Cameras) -> Cameras:
        factors = torch.ones(4, 4, dtype=torch.float64)
        factors[:3, 3] = factor
        return Cameras(at.K, at.camera_to_world * factors, at.object_to_world * factors)

    def change(frame: Frame) -> Frame:
        moved = replace(frame, now=cameras(frame.now), previous=cameras(frame.previous))
        return scaled(moved, LENGTHS, factor)

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
        return frame.with_channels(tensors)


@lru_cache(maxsize=4 * NOISE_PERIOD)
def lit_frame(surfaces: FrameChange, size: Size, index: int, seed: int | None) -> Frame:
    """Frame `index` of the synthetic sequence, with surfaces changed before they are under light of irradiance 1.

    With the noise of one sample per pixel, or without noise if no seed.
    """
    frame = surfaces(synthetic_frame(index, *size))
    reflected = to_image((frame.divisor * (frame.depth > 0)).double())
    light = {name: share * reflected for name, share in LIGHT_SHARES.items()}
    if seed is not None:
        rng = np.random.default_rng(seed)
        light = {name: noisy(rng, mean, HIT_SHARES[name]) for name, mean in light.items()}
        buffers = split_into_buffers(light, (seed, 1))
    else:
        buffers = {SAMPLE_BUFFERS[name]: np.stack([mean, mean]) for name, mean in light.items()}
    channels = (light | buffers).items()
    return frame.with_channels({name: to_tensor(array, CHANNELS[name].has_buffers) for name, array in channels})


@dataclass(frozen=True)
class StressCase:
    """A sequence of frames, how they or the denoiser are changed, and the expected output.

    The sequence shows a moving scene under light of irradiance 1, free of noise at first, then noisy.
    """

    name: str
    surfaces: FrameChange = as_is  # change of the surfaces before they are lit
    change: FrameChange = as_is  # change of the lit frames, of all or `only` of that index
    only: int | None = None
    size: Size = CASE_SIZE
    frame_count: int = CASE_FRAMES  # of the sequence; the first `even_frames` of them are free of noise
    even_frames: int = EVEN_FRAMES
    still: bool = False  # neither the camera nor anything else moves
    # "truth", in frames free of noise; "own", the denoiser's output without `change`, times `gain`; "float32", its
    # output in that precision; "past", its output for the same noise half a long sequence earlier
    compare_with: Literal["truth", "own", "float32", "past"] = "truth"
    gain: float = 1
    logits: float | None = None  # the value to which the largest output of a kernel predictor's last layers is scaled
    precision: str = "float32"  # the denoiser's, a key of PRECISIONS

    def frames(self, change: FrameChange | None = None) -> Iterator[Frame]:
        """The sequence, changed by `change`, by default the case's own."""
        change = change or self.change
        for index in range(self.frame_count):
            seed = index % NOISE_PERIOD if index >= self.even_frames else None
            frame = lit_frame(self.surfaces, self.size, 0 if self.still else index, seed)
            yield change(frame) if self.only in (None, index) else frame

    @property
    def poison(self) -> PixelChange | None:
        """The change, if it sets a pixel that is not finite."""
        return self.change if isinstance(self.change, PixelChange) and not math.isfinite(self.change.value) else None


def bad_pixel(name: str, value: float, channels: tuple[str, ...]) -> StressCase:
    """One bad pixel in one frame, without noise or motion, so that nothing but the denoiser removes it."""
    frame_count = SPOILED_FRAME + 1 + RECOVERY_LIMIT
    return StressCase(
        name,
        change=PixelChange(value, channels),
        only=SPOILED_FRAME,
        frame_count=frame_count,
        even_frames=frame_count,
        still=True,
        compare_with="own",
    )


STRESS_CASES = (
    StressCase("even light, then noise"),
    StressCase("all black", change=light_times(0)),
    bad_pixel("a firefly of 65504", 65504, (*NOISY_CHANNELS, *SAMPLE_BUFFERS.values())),
    StressCase("radiance 1e-7", change=light_times(1e-7), compare_with="own", gain=1e-7),
    StressCase("radiance 6e4", change=light_times(6e4), compare_with="own", gain=6e4),
    StressCase("radiance 1e-7 to 6e4", change=lambda frame: scaled(frame, LIGHT_CHANNELS, ramp(frame, 1e-7, 6e4))),
    bad_pixel("NaN in a pixel's light", math.nan, LIGHT_CHANNELS),
    bad_pixel("Inf in a pixel's light", math.inf, LIGHT_CHANNELS),
    bad_pixel("NaN in a pixel's surface", math.nan, SURFACE_CHANNELS),
    bad_pixel("Inf in a pixel's surface", math.inf, SURFACE_CHANNELS),
    StressCase("albedo 0", surfaces=channels_at(albedo=0.0)),
    StressCase(
        "no surface at all", surfaces=channels_at(albedo=1.0, normal=0.0, depth=0.0, roughness=1.0, mesh_id=0.0)
    ),
    StressCase("a mirror", surfaces=channels_at(albedo=1.0, roughness=0.0)),
    StressCase("depth near 1e-4", surfaces=lengths_times(2e-5)),
    StressCase("depth near 1e6", surfaces=lengths_times(2e5)),
    StressCase("depth 1e-4 to 1e6", surfaces=near_to_far),
    StressCase("motion far outside", surfaces=channels_at(**dict.fromkeys(MOTION_CHANNELS, (1e5, -1e30)))),
    StressCase("1 x 1 px", size=(1, 1)),
    StressCase("37 x 1 px", size=(1, 37)),
    StressCase("1 x 37 px", size=(37, 1)),
    StressCase("47 x 31 px", size=(31, 47)),
    StressCase("logits to ±1e4", logits=1e4),
    StressCase("bfloat16", compare_with="float32", precision="bfloat16"),
    StressCase("float16", compare_with="float32", precision="float16"),
)
LONG_CASE = StressCase("10 000 frames", size=(8, 8), frame_count=10_000, even_frames=0, still=True, compare_with="past")
