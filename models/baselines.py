"""The two baselines that every denoiser must beat: nothing, and temporal accumulation alone."""

from dataclasses import dataclass

from torch import Tensor

from datasets.frame import Frame
from models.denoiser import Denoiser, State
from models.operators import Accumulation, accumulate


class Noisy(Denoiser):
    """The noisy frame itself."""

    reads = ("direct", "indirect", "emission")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return frame.radiance(self.signal), State()


@dataclass(frozen=True)
class AccumulatedState(State):
    history: Accumulation


class Accumulated(Denoiser):
    """Temporal accumulation of irradiance along motion vectors (SVGF §4.1), no spatial filter."""

    reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "mesh_id", "motion")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        history = state.history if isinstance(state, AccumulatedState) else None
        history = accumulate(frame, frame.irradiance(self.signal), history)
        return frame.remodulate(history.irradiance, self.signal), AccumulatedState(history)
