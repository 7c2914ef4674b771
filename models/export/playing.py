"""Running a step over a sequence of frames, by whatever computes it."""

from collections.abc import Callable, Iterable, Iterator

from torch import Tensor

from datasets.frame import Frame
from models.export.step import Step, Tensors
from models.history.geometry import GBuffer
from models.history.reprojection import reproject

Compute = Callable[[dict[str, Tensor]], dict[str, Tensor]]  # outputs by name, of inputs by name


def warped(step: Step, state: dict[str, Tensor], frame: Frame, before: Frame) -> dict[str, Tensor]:
    """The state moved along with the surfaces, as far as that is left to the caller."""
    moved = {
        each.port.name: reproject(frame, state[each.port.name], GBuffer.of(before))[0]
        for each in step.carried
        if each.warped
    }
    return {**state, **moved}


def play(step: Step, frames: Iterable[Frame], compute: Compute) -> Iterator[tuple[Tensors, Tensors]]:
    """Inputs and outputs of each frame (B = 1). Where a frame does not follow the one before, the state begins anew."""
    before: Frame | None = None
    state: dict[str, Tensor] = {}
    for frame in frames:
        if before is None or not frame.follows(before.moment):
            state = step.initial(frame)
        else:
            state = warped(step, state, frame, before)
        inputs = {**step.feeds(frame), **state}
        outputs = compute(inputs)
        yield inputs, outputs
        state = step.state(inputs, outputs)
        before = frame
