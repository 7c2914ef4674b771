"""The range within which a denoiser's output must stay: for convex filters, that of all irradiance so far."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from datasets.frame import Frame
from models.denoiser import Denoiser
from models.operators import finite

ROUNDING = 1e-4  # relative; of sums in float32, demodulation and back
MIN_LIMIT = 1e-30  # ends of the range below it are not divided by


class IrradianceRange:
    """The range of surfaces' irradiance since the first frame, for each colour.

    For a filter that `separates_lights`, the limits are the sums of those of direct and indirect light.
    """

    def __init__(self, separates_lights: bool):
        self.separate = separates_lights
        self.low = torch.tensor(torch.inf)
        self.high = torch.tensor(-torch.inf)

    def add(self, frame: Frame) -> None:
        parts = [frame.direct / frame.divisor, frame.indirect / frame.divisor]
        irradiance = torch.cat(parts if self.separate else [frame.irradiance("total")]).double()
        surface = frame.depth > 0
        self.low = torch.minimum(self.low, torch.where(surface, irradiance, torch.inf).amin((2, 3)))
        self.high = torch.maximum(self.high, torch.where(surface, irradiance, -torch.inf).amax((2, 3)))

    def violation(self, frame: Frame, output: Tensor) -> float:
        """How far radiance `output` (3, H, W) of surfaces is outside, relative to the limit; at most 0 inside."""
        irradiance = finite((output - frame.emission).double() / frame.divisor)[0, :, frame.depth[0, 0] > 0]
        if irradiance.numel() == 0:
            return 0.0
        low = self.low.sum(dim=0)
        high = self.high.sum(dim=0)
        above = (irradiance.amax(dim=1) - high) / high.clamp(min=MIN_LIMIT)
        below = (low - irradiance.amin(dim=1)) / low.clamp(min=MIN_LIMIT)
        return float(torch.maximum(above, below).max())


def range_violation(denoiser: Denoiser, frames: Iterable[Frame], outputs: Sequence[Tensor]) -> float:
    """The largest distance of `outputs` (3, H, W) from their range; 0 inside.

    Relative to the range's end for a convex filter; for others the absolute value below 0. Values that are not finite
    count as 0.
    """
    if not denoiser.convex:
        return max(0.0, *(-float(finite(output).min()) for output in outputs))
    irradiance_range = IrradianceRange(denoiser.separates_lights)
    largest = 0.0
    for frame, output in zip(frames, outputs, strict=True):
        irradiance_range.add(frame.finite())
        largest = max(largest, irradiance_range.violation(frame.finite(), output))
    return largest
