"""The base class of wrappers: denoisers that change the input or output of another one."""

from collections.abc import Iterator
from typing import ClassVar

import torch
from torch import Tensor

from datasets.frame import Frame
from models.denoiser import Denoiser, State


class Wrapper(Denoiser):
    """A denoiser that wraps another one and takes over its attributes, apart from those of its output's light."""

    needs: ClassVar[tuple[str, ...]] = ()  # channels, beside those of the inner denoiser

    def __init__(self, inner: Denoiser):
        super().__init__(signal=inner.signal)
        self.inner = inner
        self.reads = tuple(dict.fromkeys((*inner.reads, *self.needs)))
        for fact in ("refuses", "made_from", "is_network", "offline", "constants"):
            setattr(self, fact, getattr(inner, fact))

    def unavailable(self) -> str | None:
        return self.inner.unavailable()

    def run(self, frame: Frame, state: State | None) -> tuple[Tensor, State]:
        return self.forward(frame, state)  # the inner denoiser is run layer by layer

    def prepare(self, precision: torch.dtype = torch.float32) -> None:
        self.inner.prepare(precision)
        super().prepare(precision)


def layers_of(denoiser: Denoiser) -> Iterator[Denoiser]:
    """The denoiser and those that it wraps, outermost first."""
    yield denoiser
    while isinstance(denoiser, Wrapper):
        denoiser = denoiser.inner
        yield denoiser


def unwrapped(denoiser: Denoiser) -> Denoiser:
    """The denoiser without its wrappers."""
    *_, innermost = layers_of(denoiser)
    return innermost
