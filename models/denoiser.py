"""The one interface of everything that denoises."""

from dataclasses import dataclass
from typing import ClassVar, TypeVar

import torch
from torch import Tensor

from datasets.frame import Frame, Signal


@dataclass(frozen=True)
class State:
    """What a denoiser carries from frame to frame: tensors. Each denoiser has a subclass of its own."""

    shape: tuple[int, int, int]  # (B, H, W) of the frames it was made from


S = TypeVar("S", bound=State)


def carried(state: State | None, kind: type[S], frame: Frame) -> S | None:
    """The state as one's own kind, or None where a frame of another image or batch size starts a new sequence."""
    return state if isinstance(state, kind) and state.shape == frame.shape else None


class Denoiser(torch.nn.Module):
    """One frame in, linear HDR radiance out.

    Attributes:
        reads: channels it needs; nothing else is loaded, rendered or stored for it.
        signal: what it returns; "total" denoises direct + indirect and adds emission back untouched.
    """

    reads: ClassVar[tuple[str, ...]]
    signal: Signal = "total"

    def forward(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        """Radiance (B, 3, H, W) of `signal`, non-negative, and the state for the next frame.

        `state` is None on the first frame of a sequence; a state of another image size is discarded.
        """
        raise NotImplementedError

    def parameter_count(self) -> int:
        return sum(parameter.numel() for parameter in self.parameters())
