"""The two baselines that every denoiser must beat: no denoising, and temporal accumulation alone."""

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from datasets.frame import Frame, Signal
from models.denoiser import CLASSICAL, Denoiser, State, matching_state
from models.history.accumulation import Accumulation, accumulate


class Noisy(Denoiser):
    """The noisy frame itself."""

    made_from = "ours"
    reads = ("direct", "indirect", "emission")
    refuses = CLASSICAL
    convex = True
    has_kernels = False
    blends_layers = True
    baseline_for: tuple[Signal, ...] = ("total", "indirect")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return frame.radiance(self.signal), State(frame.moment)


@dataclass(frozen=True)
class AccumulatedState(State):
    history: Accumulation

    def pictures(self) -> dict[str, Tensor]:
        return {"history length": self.history.length}


class Accumulating(Denoiser):
    """A denoiser whose input is accumulated irradiance; models.wrappers.adaptive replaces `accumulation`."""

    reads: tuple[str, ...] = ("direct", "indirect", "emission", "albedo", "normal", "depth", "mesh_id", "motion")
    accumulation: Callable[[Frame, Tensor, Accumulation | None], Accumulation] = staticmethod(accumulate)

    def accumulated(self, frame: Frame, previous: AccumulatedState | None) -> Accumulation:
        """The frame's irradiance, blended into its history."""
        return self.accumulation(frame, frame.irradiance(self.signal), previous.history if previous else None)


class Accumulated(Accumulating):
    """Temporal accumulation of irradiance along motion vectors (SVGF §4.1), without a spatial filter."""

    made_from = "paper"
    refuses = CLASSICAL
    convex = True
    baseline_for: tuple[Signal, ...] = ("total", "indirect")

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        history = self.accumulated(frame, matching_state(state, AccumulatedState, frame))
        return frame.remodulate(history.irradiance, self.signal), AccumulatedState(frame.moment, history)
