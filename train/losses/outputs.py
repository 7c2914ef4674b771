"""What a network makes of a batch, as exposed radiance: what losses for any network compare."""

from collections.abc import Iterator
from typing import Any

from torch import Tensor

from datasets.frame import Frame
from models.denoiser import Denoiser
from models.history.running_scale import RunningScale
from models.networks.rae import POWER, RAE
from train.crops import Crops
from train.sequences import Batch

DARKEST_SLOPE = 0.01  # exposed irradiance, below which RAE's output has no flatter slope


def raised(p: Tensor) -> Tensor:
    """max(p, 0)^5, what RAE's raw output means, with a gradient that does not die at p <= 0.

    Its slope is that of p^5, but never less than where p^5 = DARKEST_SLOPE: darker than that, errors are not relative
    any more. A slope of another size, whatever the target, leaves what is best in place: a zero of the loss's gradient.
    """
    value = p.detach().clamp(min=0) ** (1 / POWER)
    slope = p.detach().clamp(min=DARKEST_SLOPE**POWER) ** (1 / POWER - 1) / POWER
    return value + slope * (p - p.detach())


def outputs(denoiser: Any, batch: Batch | Crops) -> Iterator[tuple[Frame, Tensor, RunningScale]]:
    """Each frame with what the network returns and the running scale there."""
    if isinstance(batch, Crops):
        irradiance, _ = denoiser.filter(batch.frame, batch.irradiance, batch.scale)
        yield batch.frame, irradiance, batch.scale
        return
    state: Any = None
    for frame in batch.frames:
        output, state = denoiser.predict(frame, state)
        yield frame, output, state.scale


def exposed_outputs(denoiser: Denoiser, batch: Batch | Crops) -> Iterator[tuple[Frame, Tensor, Tensor]]:
    """Each frame, the radiance (B, 3, H, W) that surfaces reflect by the network, exposed, and the exposure.

    The exposure (B, 1 or 3, 1, 1) includes the gain. Emission is left out. What the network returns may be below 0.
    """
    for frame, output, scale in outputs(denoiser, batch):
        exposure = scale.exposure() * frame.gain
        irradiance = raised(output) if isinstance(denoiser, RAE) else exposure * output
        yield frame, irradiance * frame.divisor, exposure
