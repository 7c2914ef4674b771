"""Extremes that every denoiser must survive, as data: each says how it changes an ordinary sequence of frames."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from datasets.frame import Cameras, Frame, to_tensor
from eval.bench.synthetic_frames import HIT_DIRECT, HIT_INDIRECT, noisy, synthetic_frame

Size = tuple[int, int]  # height, width in px
Change = Callable[[Frame], Frame]

SIZE: Size = (32, 48)
FRAMES, EVEN = 10, 4  # of a sequence; those at its start in even light
SHARES = {"direct": 0.7, "indirect": 0.3}  # of the irradiance, which is 1
LIGHT = ("direct", "indirect", "emission")
SURFACE = ("albedo", "normal", "depth", "roughness", "mesh_id", "motion", "dual_motion")
SPOILED = 2  # index of the frame with one bad pixel
RECOVERY_LIMIT = 60  # frames after it: a second or two
PERIOD = 100  # frames until the noise of a long sequence repeats


def unchanged(frame: Frame) -> Frame:
    return frame


def scaled(factor: float) -> Change:
    """All light times `factor`."""
    return lambda frame: replace(frame, channels=frame.channels | {n: factor * frame.channels[n] for n in LIGHT})


def having(**values: float | tuple[float, ...]) -> Change:
    """Channels that have one value, or one a component, in all pixels."""

    def change(frame: Frame) -> Frame:
        tensors = {name: torch.zeros_like(frame.channels[name]) for name in values}
        for name, value in values.items():
            tensors[name] += torch.tensor(value).view(-1, 1, 1)
        return replace(frame, channels=frame.channels | tensors)

    return change


def ramp(frame: Frame, low: float, high: float) -> Tensor:
    """From `low` at the left to `high` at the right, evenly in the logarithm, (W,)."""
    return torch.logspace(math.log10(low), math.log10(high), frame.size[1])


def from_dim_to_bright(frame: Frame) -> Frame:
    """Irradiance from 1e-7 to 6e4 across the image."""
    factors = ramp(frame, 1e-7, 6e4)
    return replace(frame, channels=frame.channels | {name: frame.channels[name] * factors for name in LIGHT})


def from_near_to_far(frame: Frame) -> Frame:
    """Depth from 1e-4 to 1e6 across the image, the cameras as they are: what moves is not where it is expected."""
    depth = torch.where(frame.depth > 0, ramp(frame, 1e-4, 1e6), 0)
    return replace(frame, channels=frame.channels | {"depth": depth})


def resized(factor: float) -> Change:
    """The same scene in other units: depth and cameras times `factor`."""

    def cameras(at: Cameras) -> Cameras:
        factors = torch.ones(4, 4, dtype=torch.float64)
        factors[:3, 3] = factor
        return Cameras(at.K, at.camera_to_world * factors, at.object_to_world * factors)

    def change(frame: Frame) -> Frame:
        channels = frame.channels | {"depth": factor * frame.depth}
        return replace(frame, channels=channels, now=cameras(frame.now), previous=cameras(frame.previous))

    return change


@dataclass(frozen=True)
class Pixel:
    """A change of the pixel in the middle: `value` in all components of the named channels."""

    value: float
    names: tuple[str, ...]

    def __call__(self, frame: Frame) -> Frame:
        tensors = {name: frame.channels[name].clone() for name in self.names}
        for tensor in tensors.values():
            tensor[..., frame.size[0] // 2, frame.size[1] // 2] = self.value
        return replace(frame, channels=frame.channels | tensors)


def lit(frame: Frame, seed: int | None) -> Frame:
    """Under light of irradiance 1 everywhere: as it is, or as one sample a pixel finds it."""
    divisor = frame.divisor[0].permute(1, 2, 0).double().numpy()
    light = {name: share * divisor for name, share in SHARES.items()}
    if seed is not None:
        rng = np.random.default_rng(seed)
        hits = {"direct": HIT_DIRECT, "indirect": HIT_INDIRECT}
        light = {name: noisy(rng, mean, hits[name]) for name, mean in light.items()}
    return replace(frame, channels=frame.channels | {name: to_tensor(array) for name, array in light.items()})


@lru_cache(maxsize=4 * PERIOD)
def lit_frame(surfaces: Change, size: Size, index: int, seed: int | None) -> Frame:
    return lit(surfaces(synthetic_frame(index, *size)), seed)


@dataclass(frozen=True)
class Extreme:
    """A sequence of frames to denoise, how they or the denoiser are changed, and what the answer is held to.

    Surfaces of a moving scene (eval/bench/synthetic_frames.py) under light of irradiance 1, even at first, then noisy.

    Attributes:
        surfaces: how surfaces are changed before light falls on them.
        change: how lit frames are changed, all or `only` one.
        still: the camera and everything else stands still.
        held_to: the truth, which is known in even light; "own", the denoiser's answer without `change`, times `gain`;
            "float32", its answer in that precision; or "past", that to the same noise early in a long sequence.
        logits: what the largest output of a kernel predictor's last layers is scaled to.
    """

    name: str
    surfaces: Change = unchanged
    change: Change = unchanged
    only: int | None = None
    size: Size = SIZE
    count: int = FRAMES
    even: int = EVEN
    still: bool = False
    held_to: Literal["truth", "own", "float32", "past"] = "truth"
    gain: float = 1
    logits: float | None = None
    precision: torch.dtype = torch.float32

    def frames(self, change: Change | None = None) -> Iterator[Frame]:
        """The sequence, changed by `change`, by default its own."""
        change = change or self.change
        for index in range(self.count):
            seed = index % PERIOD if index >= self.even else None
            frame = lit_frame(self.surfaces, self.size, 0 if self.still else index, seed)
            yield change(frame) if self.only in (None, index) else frame

    @property
    def poison(self) -> Pixel | None:
        """The change, where it is a pixel that is not finite."""
        return self.change if isinstance(self.change, Pixel) and not math.isfinite(self.change.value) else None

    @staticmethod
    def of_pixel(name: str, value: float, channels: tuple[str, ...]) -> "Extreme":
        """One bad pixel in one frame; even light and no motion, in which nothing else would make it forgotten."""
        count = SPOILED + 1 + RECOVERY_LIMIT
        change = Pixel(value, channels)
        return Extreme(name, change=change, only=SPOILED, count=count, even=count, still=True, held_to="own")


EXTREMES = (
    Extreme("even light, then noise"),
    Extreme("all black", change=scaled(0)),
    Extreme.of_pixel("a firefly of 65504", 65504, ("direct", "indirect")),
    Extreme("radiance 1e-7", change=scaled(1e-7), held_to="own", gain=1e-7),
    Extreme("radiance 6e4", change=scaled(6e4), held_to="own", gain=6e4),
    Extreme("radiance 1e-7 to 6e4", change=from_dim_to_bright),
    Extreme.of_pixel("NaN in a pixel's light", math.nan, LIGHT),
    Extreme.of_pixel("Inf in a pixel's light", math.inf, LIGHT),
    Extreme.of_pixel("NaN in a pixel's surface", math.nan, SURFACE),
    Extreme.of_pixel("Inf in a pixel's surface", math.inf, SURFACE),
    Extreme("albedo 0", having(albedo=0.0)),
    Extreme("no surface at all", having(albedo=1.0, normal=0.0, depth=0.0, roughness=1.0, mesh_id=0.0)),
    Extreme("a mirror", having(albedo=1.0, roughness=0.0)),
    Extreme("depth around 1e-4", resized(2e-5)),
    Extreme("depth around 1e6", resized(2e5)),
    Extreme("depth 1e-4 to 1e6", from_near_to_far),
    Extreme("motion far outside", having(motion=(1e5, -1e30), dual_motion=(1e5, -1e30))),
    Extreme("1 x 1 px", size=(1, 1)),
    Extreme("37 x 1 px", size=(1, 37)),
    Extreme("1 x 37 px", size=(37, 1)),
    Extreme("47 x 31 px", size=(31, 47)),
    Extreme("logits to ±1e4", logits=1e4),
    Extreme("bfloat16", held_to="float32", precision=torch.bfloat16),
    Extreme("float16", held_to="float32", precision=torch.float16),
)
LONG = Extreme("10 000 frames", size=(8, 8), count=10_000, even=0, still=True, held_to="past")
