"""The two baselines that every denoiser must beat: nothing, and temporal accumulation alone."""

from dataclasses import dataclass

from torch import Tensor

from datasets.frame import Frame
from models.accumulation import Accumulation, accumulate
from models.denoiser import CLASSICAL, Denoiser, State, matching_state


class Noisy(Denoiser):
    """The noisy frame itself."""

    reads = ("direct", "indirect", "emission")
    refuses = CLASSICAL

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return frame.radiance(self.signal), State(frame.moment)


@dataclass(frozen=True)
class AccumulatedState(State):
    history: Accumulation

    def pictures(self) -> dict[str, Tensor]:
        return {"history length": self.history.length}


class Accumulated(Denoiser):
    """Temporal accumulation of irradiance along motion vectors (SVGF §4.1), no spatial filter."""

    reads = ("direct", "indirect", "emission", "albedo", "normal", "depth", "mesh_id", "motion")
    refuses = CLASSICAL

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        before = matching_state(state, AccumulatedState, frame)
        history = accumulate(frame, frame.irradiance(self.signal), before.history if before else None)
        return frame.remodulate(history.irradiance, self.signal), AccumulatedState(frame.moment, history)
