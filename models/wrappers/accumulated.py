"""NAME+accumulated: temporal accumulation after a denoiser, which gives one without a history one."""

from dataclasses import dataclass

from torch import Tensor

from datasets.frame import Frame
from models.denoiser import Denoiser, State, matching_state
from models.filters.baselines import AccumulatedState, Accumulating
from models.wrappers.wrapper import Wrapper


@dataclass(frozen=True)
class AccumulatedAfterState(AccumulatedState):
    """The history of denoised irradiance, and the inner denoiser's state."""

    inner: State

    def pictures(self) -> dict[str, Tensor]:
        return super().pictures() | self.inner.pictures()


class AccumulatedAfter(Wrapper, Accumulating):
    """Denoised irradiance averaged over frames along motion vectors, as models.filters.baselines.Accumulated does.

    With +adaptive after it, by adaptive accumulation.
    """

    needs = ("emission", "albedo", "normal", "depth", "mesh_id", "motion")

    def __init__(self, inner: Denoiser):
        super().__init__(inner)
        self.convex = inner.convex

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        previous = matching_state(state, AccumulatedAfterState, frame)
        output, inner = self.inner.run(frame, previous.inner if previous else None)
        irradiance = frame.demodulate(output, self.signal)
        history = self.accumulation(frame, irradiance, previous.history if previous else None)
        return frame.remodulate(history.irradiance, self.signal), AccumulatedAfterState(frame.moment, history, inner)
