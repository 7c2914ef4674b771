"""One denoiser at one extreme: what comes of it, and which requirements it breaks."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from datasets.frame import Frame
from eval.bench.race import network_of
from eval.stress.cases import PERIOD, RECOVERY_LIMIT, SPOILED, Extreme, Pixel, unchanged
from models.denoiser import Denoiser
from models.operators import finite

CONVEX = ("eaw", "svgf", "wskp3", "wskp6", "kp")  # filters whose output is a mean of irradiance that they have seen
ROUNDING = 1e-4  # relative; of sums in float32, demodulation and back
FORGOTTEN = 1e-3  # of the brightest pixel: what changes none by more has no effect any more
ROUNDINGS = 10  # of half precision are no effect either: networks amplify them, RAE by its power of 5 alone
ORDINARY = (0.0, 1.0)  # values that a pixel may well have: they tell which others see it
SMALLEST = 1e-30
REQUIREMENTS = {
    "finite": "what comes of finite pixels is finite",
    "range": f"{', '.join(CONVEX)} stay within the irradiance seen since the last reset; no other goes below 0",
    "spread": "a pixel that is not finite changes none that could not see it in that frame",
    "recovery": f"{RECOVERY_LIMIT} frames later it changes none by more than {FORGOTTEN:.1%} of the brightest, or "
    f"{ROUNDINGS} times the rounding of half precision",
}


@dataclass(frozen=True)
class Outcome:
    """What came of a denoiser at an extreme.

    Attributes:
        error: the largest, over the brightest pixel of what the answer is held to, absolute where that is black; None
            where no pixel is finite.
        nonfinite: output pixels, of all frames.
        violation: how far the output leaves its range, over the range's end (convex filters), or below 0 (others).
        recovery: frames until a bad pixel is forgotten, 0 where nothing shows it; None where that never happens, and
            at extremes without one.
        broken: the requirements that are not kept, of REQUIREMENTS.
    """

    error: float | None
    nonfinite: int
    violation: float
    recovery: int | None
    broken: tuple[str, ...]


def heads(denoiser: Denoiser) -> list[nn.Module]:
    """The last layers of a kernel predictor, whose outputs are its logits; none of other denoisers."""
    network = network_of(denoiser)
    if isinstance(network, nn.Sequential):
        return [network[-1]]
    return list(getattr(network, "heads", ()))


@contextmanager
def largest_logits(denoiser: Denoiser, size: float | None) -> Iterator[None]:
    """Scale the logits so that the largest of each frame is `size`, unless that is None."""

    def scale(layer: nn.Module, inputs: Any, output: Tensor) -> Tensor:
        logits = output.float()  # the factor may overflow half precision
        return (logits * ((size or 1) / logits.abs().max().clamp(min=SMALLEST))).to(output.dtype)

    hooks = [layer.register_forward_hook(scale) for layer in heads(denoiser)] if size else []
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


def play(denoiser: Denoiser, frames: Iterable[Frame]) -> list[Tensor]:
    """Radiance (3, H, W) of every frame of a sequence."""
    outputs, state = [], None
    for frame in tqdm(frames, "frames", leave=False, delay=2):
        output, state = denoiser(frame, state)
        outputs.append(output[0])
    return outputs


class Range:
    """The irradiance that a convex filter has seen since it began: what it must stay within, for each colour.

    SVGF filters direct and indirect light by themselves, so that its limits are sums of two.
    """

    def __init__(self, name: str):
        self.split = name == "svgf"
        self.low, self.high = torch.tensor(torch.inf), torch.tensor(-torch.inf)

    def see(self, frame: Frame) -> None:
        parts = [frame.direct / frame.divisor, frame.indirect / frame.divisor]
        seen = torch.cat(parts if self.split else [frame.irradiance("total")]).double()
        self.low, self.high = torch.minimum(self.low, seen.amin((2, 3))), torch.maximum(self.high, seen.amax((2, 3)))

    def violation(self, frame: Frame, output: Tensor) -> float:
        """How far radiance `output` (3, H, W) is outside, relative to the limit; at most 0 inside."""
        irradiance = finite((output - frame.emission).double() / frame.divisor)[0].flatten(1)
        low, high = self.low.sum(dim=0), self.high.sum(dim=0)
        above = (irradiance.amax(dim=1) - high) / high.clamp(min=SMALLEST)
        below = (low - irradiance.amin(dim=1)) / low.clamp(min=SMALLEST)
        return float(torch.maximum(above, below).max())


def range_violation(name: str, frames: Iterable[Frame], outputs: Sequence[Tensor]) -> float:
    """The largest of a sequence, see Outcome; 0 where there is none. What is not finite counts as 0 on both sides."""
    if name not in CONVEX:
        return max(0.0, *(-float(finite(output).min()) for output in outputs))
    largest, seen = 0.0, Range(name)
    for frame, output in zip(frames, outputs, strict=True):
        seen.see(frame.finite())
        largest = max(largest, seen.violation(frame.finite(), output))
    return largest


def finite_pixels(frame: Frame, names: Iterable[str]) -> Tensor:
    """Where all the named channels are finite, (H, W)."""
    return torch.stack([torch.isfinite(frame.channels[name]).all(dim=1)[0] for name in names]).all(dim=0)


def differences(outputs: Iterable[Tensor], expected: Iterable[Tensor]) -> list[Tensor]:
    """Absolute differences (3, H, W), each over the brightest pixel of the frame expected, unless that is black."""
    pairs = zip(outputs, expected, strict=True)
    return [(a - b).abs() / (float(b.max()) if b.max() > SMALLEST else 1) for a, b in pairs]


def forgotten(precision: torch.dtype) -> float:
    """The largest change, over the brightest pixel, that counts as none."""
    return max(FORGOTTEN, ROUNDINGS * torch.finfo(precision).eps)


def largest_finite(errors: Iterable[Tensor]) -> float | None:
    found = [error[torch.isfinite(error)] for error in errors]
    return max((float(error.max()) for error in found if len(error)), default=None)


class Trial:
    """The way of the denoiser called `name` through an extreme.

    `build` makes it in a given precision, always with the same weights; it must take the extreme's.
    """

    def __init__(self, name: str, build: Callable[[torch.dtype], Denoiser], extreme: Extreme):
        self.name, self.build, self.extreme = name, build, extreme
        self.denoiser = build(extreme.precision)
        self.frames = list(extreme.frames())
        with largest_logits(self.denoiser, extreme.logits):
            self.outputs = play(self.denoiser, self.frames)

    def errors(self) -> list[Tensor]:
        """Differences (3, H, W) from what the extreme holds the answer to, of the frames of which that is known."""
        if self.extreme.held_to == "truth":
            even = self.frames[: self.extreme.even]
            return differences(self.outputs[: len(even)], [frame.radiance(self.denoiser.signal)[0] for frame in even])
        if self.extreme.held_to == "past":
            return differences(self.outputs[-PERIOD:], self.outputs[PERIOD : 2 * PERIOD])
        other = self.denoiser if self.extreme.held_to == "own" else self.build(torch.float32)
        expected = play(other, self.extreme.frames(unchanged))
        return differences(self.outputs, [self.extreme.gain * output for output in expected])

    def spreads(self, pixel: Pixel) -> bool:
        """Whether the spoiled frame differs where no ordinary value of the pixel changes anything."""

        def spoiled_frame(change: Callable[[Frame], Frame]) -> Tensor:
            return play(self.denoiser, list(self.extreme.frames(change))[: SPOILED + 1])[-1]

        clean = spoiled_frame(unchanged)
        seen = [(spoiled_frame(replace(pixel, value=value)) != clean).any(dim=0) for value in ORDINARY]
        changed = (self.outputs[SPOILED] != clean).any(dim=0)  # NaN is a change, too
        return bool((changed & ~torch.stack(seen).any(dim=0)).any())

    def recovery(self, changed: Sequence[Tensor]) -> int | None:
        """Frames after the spoiled one until nothing is `changed` (H, W) any more; None if that is not reached."""
        frames = max((index + 1 - SPOILED for index, where in enumerate(changed) if where.any()), default=0)
        return frames if frames <= RECOVERY_LIMIT else None

    def outcome(self) -> Outcome:
        errors, recovery = self.errors(), None
        bad = [~torch.isfinite(output).all(dim=0) for output in self.outputs]
        good_input = [finite_pixels(frame, self.denoiser.reads) for frame in self.frames]
        violation = range_violation(self.name, self.frames, self.outputs)
        broken = {
            "finite": any((a & b).any() for a, b in zip(bad, good_input, strict=True)),
            "range": violation > (ROUNDING if self.name in CONVEX else 0),
        }
        if self.extreme.only is not None:
            limit = forgotten(self.extreme.precision)
            changed = [~(error <= limit).all(dim=0) for error in errors]  # NaN is a change, too
            recovery = self.recovery(changed)
            if poison := self.extreme.poison:
                broken["spread"] = self.spreads(poison)
                broken["recovery"] = recovery is None
        nonfinite = sum(int(where.sum()) for where in bad)
        missed = tuple(name for name in REQUIREMENTS if broken.get(name))
        return Outcome(largest_finite(errors), nonfinite, violation, recovery, missed)
