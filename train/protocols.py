"""What the trainer needs of a network, beside what every denoiser has."""

from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from datasets.frame import Frame, Signal
from models.history.accumulation import Accumulation
from models.history.running_scale import RunningScale


class ScaledState(Protocol):
    """A state with the running exposure and depth scale of its sequence."""

    @property
    def scale(self) -> RunningScale: ...


class AccumulatingState(ScaledState, Protocol):
    """One with accumulated irradiance too."""

    @property
    def history(self) -> Accumulation: ...


@runtime_checkable
class RecurrentNetwork(Protocol):
    """A network that is trained on sequences, through time."""

    signal: Signal

    def predict(self, frame: Frame, state: Any) -> tuple[Tensor, ScaledState]:
        """The network's output for a frame, (B, 3, H, W) in its own space, not clamped, and the next state."""

    def exposed(self, prediction: Tensor, exposure: Tensor) -> Tensor:
        """Irradiance times exposure, of what `predict` returned, with a gradient everywhere."""


@runtime_checkable
class CompressingNetwork(RecurrentNetwork, Protocol):
    """One whose loss compares images in the space of its inputs."""

    def compress(self, irradiance: Tensor, scale: RunningScale, frame: Frame) -> Tensor:
        """Irradiance (B, 3, H, W) in that space."""


@runtime_checkable
class FilteringNetwork(Protocol):
    """A network that filters single frames of accumulated irradiance, and is trained on crops of those."""

    signal: Signal
    reads: tuple[str, ...]  # for accumulation
    filter_reads: tuple[str, ...]

    def accumulate(self, frame: Frame, state: Any) -> AccumulatingState:
        """The state after a frame, before any filter."""

    def filter(self, frame: Frame, irradiance: Tensor, scale: RunningScale) -> tuple[Tensor, object]:
        """Filtered irradiance (B, 3, H, W), not clamped, and what is only displayed."""
