"""One denoiser in one stress case: its errors, and the requirements that it breaks."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from tqdm import tqdm

from datasets.frame import Frame
from eval.bench.denoisers import network_of
from eval.stress.cases import NOISE_PERIOD, RECOVERY_LIMIT, SPOILED_FRAME, FrameChange, PixelChange, StressCase, as_is
from models.denoiser import Denoiser
from models.operators import MIN_DIVISOR, finite
from models.spec import PRECISIONS

ROUNDING = 1e-4  # relative; of sums in float32, demodulation and back
MAX_RESIDUE = 1e-3  # of the brightest pixel: smaller changes count as none
ROUNDINGS = 10  # of half precision count as none: networks amplify them, RAE by its power of 5 alone
ORDINARY_VALUES = (0.0, 1.0)  # of the bad pixel, to find the pixels that depend on it
FRESH = "fresh"  # instead of a file: random weights
BLACK_BELOW = 1e-30  # radiance: an image without a brighter pixel counts as black
REQUIREMENTS = {
    "finite": "outputs are finite where inputs are finite",
    "range": "convex filters stay within the range of irradiance since the last reset; no other goes below 0",
    "spread": "a pixel that is not finite changes only pixels that depend on it in that frame",
    "recovery": f"{RECOVERY_LIMIT} frames later it changes no pixel by more than {MAX_RESIDUE:.1%} of the brightest, "
    f"or {ROUNDINGS} times the rounding of half precision",
}


def denoise(denoiser: Denoiser, frames: Iterable[Frame]) -> list[Tensor]:
    """Radiance (3, H, W) of every frame of a sequence."""
    outputs = []
    state = None
    for frame in tqdm(frames, "frames", leave=False, delay=2):
        output, state = denoiser(frame, state)
        outputs.append(output[0])
    return outputs


def differences(outputs: Iterable[Tensor], expected: Iterable[Tensor]) -> list[Tensor]:
    """Absolute differences (3, H, W), relative to the brightest expected pixel of the frame unless that is black."""
    pairs = zip(outputs, expected, strict=True)
    return [(a - b).abs() / (float(b.max()) if b.max() > BLACK_BELOW else 1) for a, b in pairs]


def range_violation(denoiser: Denoiser, frames: Iterable[Frame], outputs: Sequence[Tensor]) -> float:
    """The largest distance of radiance `outputs` (3, H, W) from their range; 0 inside.

    For convex filters, surfaces' irradiance stays within that of all frames so far, for each colour; where a filter
    `separates_lights`, within the sums of the limits of direct and indirect light. The distance is relative to the
    range's end. For others it is the absolute value below 0. Values that are not finite count as 0.
    """
    if not denoiser.convex:
        return max(0.0, *(-float(finite(output).min()) for output in outputs))
    low, high = torch.tensor(torch.inf), torch.tensor(-torch.inf)
    largest = 0.0
    for frame, output in zip((frame.finite() for frame in frames), outputs, strict=True):
        apart = [frame.direct / frame.divisor, frame.indirect / frame.divisor]
        noisy = torch.cat(apart if denoiser.separates_lights else [frame.irradiance("total")]).double()
        surface = frame.depth > 0
        low = torch.minimum(low, torch.where(surface, noisy, torch.inf).amin((2, 3)))
        high = torch.maximum(high, torch.where(surface, noisy, -torch.inf).amax((2, 3)))
        irradiance = finite((output - frame.emission).double() / frame.divisor)[0, :, surface[0, 0]]
        if irradiance.numel():
            least, most = low.sum(dim=0), high.sum(dim=0)
            above = (irradiance.amax(dim=1) - most) / most.clamp(min=MIN_DIVISOR)
            below = (least - irradiance.amin(dim=1)) / least.clamp(min=MIN_DIVISOR)
            largest = max(largest, float(torch.maximum(above, below).max()))
    return largest


def last_layers(denoiser: Denoiser) -> list[nn.Module]:
    """The layers of a kernel predictor whose outputs are its logits; empty for other denoisers."""
    network = network_of(denoiser)
    if isinstance(network, nn.Sequential):
        return [network[-1]]
    return list(getattr(network, "heads", ()))


@contextmanager
def largest_logits(denoiser: Denoiser, size: float) -> Iterator[None]:
    """Scale the logits so that the largest of each frame is `size`."""

    def scale(layer: nn.Module, inputs: Any, output: Tensor) -> Tensor:
        logits = output.float()  # the factor may overflow half precision
        return (logits * (size / logits.abs().max().clamp(min=MIN_DIVISOR))).to(output.dtype)

    hooks = [layer.register_forward_hook(scale) for layer in last_layers(denoiser)]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


@dataclass(frozen=True)
class StressRow:
    """A denoiser in a stress case: a row of results.json."""

    denoiser: str
    weights: str | None  # their file, FRESH, or None for a denoiser without
    extreme: str  # the name of the case
    # the largest, relative to the brightest expected pixel, absolute if that is black; None where no pixel is finite
    error: float | None
    nonfinite: int  # output pixels that are not finite, in all frames
    violation: float  # largest distance from the range, relative to its end (convex filters), or below 0 (others)
    # frames until the effect of a bad pixel ends, 0 if it has none; None if it does not end, and in cases without a bad
    # pixel
    recovery: int | None
    broken: tuple[str, ...]  # the requirements that are not kept, keys of REQUIREMENTS


class StressCheck:
    """A denoiser's run through a stress case. `build` makes it in a precision of PRECISIONS, with the same weights."""

    def __init__(self, build: Callable[[str], Denoiser], case: StressCase):
        self.build = build
        self.case = case
        self.denoiser = build(case.precision)
        self.frames = list(case.frames())
        with nullcontext() if case.logits is None else largest_logits(self.denoiser, case.logits):
            self.outputs = denoise(self.denoiser, self.frames)

    def errors(self) -> list[Tensor]:
        """Differences (3, H, W) from the case's expected output, of the frames for which there is one."""
        if self.case.compare_with == "truth":
            even = self.frames[: self.case.even_frames]
            return differences(self.outputs[: len(even)], [frame.radiance(self.denoiser.signal)[0] for frame in even])
        if self.case.compare_with == "past":
            half = len(self.outputs) // 2  # averages have converged by then
            return differences(self.outputs[-NOISE_PERIOD:], self.outputs[half - NOISE_PERIOD : half])
        other = self.denoiser if self.case.compare_with == "own" else self.build("float32")
        expected = denoise(other, self.case.frames(as_is))
        return differences(self.outputs, [self.case.gain * output for output in expected])

    def spreads(self, pixel: PixelChange) -> bool:
        """Whether the bad pixel changes its frame where no ordinary value of that pixel does."""

        def spoiled_output(change: FrameChange) -> Tensor:
            return denoise(self.denoiser, list(self.case.frames(change))[: SPOILED_FRAME + 1])[-1]

        clean = spoiled_output(as_is)
        depends = [(spoiled_output(replace(pixel, value=value)) != clean).any(dim=0) for value in ORDINARY_VALUES]
        changed = (self.outputs[SPOILED_FRAME] != clean).any(dim=0)  # NaN is a change, too
        return bool((changed & ~torch.stack(depends).any(dim=0)).any())

    def recovery(self, errors: Sequence[Tensor]) -> int | None:
        """Frames from the bad pixel until its last effect; None for more than RECOVERY_LIMIT."""
        limit = max(MAX_RESIDUE, ROUNDINGS * torch.finfo(PRECISIONS[self.case.precision]).eps)
        changed = [index for index, error in enumerate(errors) if not (error <= limit).all()]  # NaN is a change, too
        frames = changed[-1] + 1 - SPOILED_FRAME if changed else 0
        return frames if frames <= RECOVERY_LIMIT else None

    def row(self, denoiser: str, weights: str | None) -> StressRow:
        errors = self.errors()
        finite_errors = torch.cat([error[torch.isfinite(error)] for error in errors])
        bad = [~torch.isfinite(output).all(dim=0) for output in self.outputs]
        inputs = ([frame.channels[name][0].flatten(0, -3) for name in self.denoiser.reads] for frame in self.frames)
        good_input = [torch.isfinite(torch.cat(tensors)).all(dim=0) for tensors in inputs]
        violation = range_violation(self.denoiser, self.frames, self.outputs)
        recovery = self.recovery(errors) if self.case.only is not None else None
        poison = self.case.poison
        broken = {
            "finite": any((a & b).any() for a, b in zip(bad, good_input, strict=True)),
            "range": violation > (ROUNDING if self.denoiser.convex else 0),
            "spread": poison is not None and self.spreads(poison),
            "recovery": poison is not None and recovery is None,
        }
        return StressRow(
            denoiser,
            weights,
            self.case.name,
            error=float(finite_errors.max()) if len(finite_errors) else None,
            nonfinite=sum(int(where.sum()) for where in bad),
            violation=violation,
            recovery=recovery,
            broken=tuple(name for name in REQUIREMENTS if broken[name]),
        )
