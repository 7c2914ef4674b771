"""Denoisers with something done to their output: what all of these have in common."""

from collections.abc import Iterable
from functools import cache
from typing import ClassVar, TypeVar

import torch

from datasets.frame import Signal
from models.denoiser import Denoiser


class Around(Denoiser):
    """A denoiser of `inner_class` with something done to its output; `around` makes the class."""

    inner_class: ClassVar[type[Denoiser]]

    @classmethod
    def reads_around(cls, reads: Iterable[str]) -> tuple[str, ...]:
        """The channels that the inner denoiser `reads`, and those that are read for its output."""
        raise NotImplementedError

    def __init__(self, *, signal: Signal | None = None):
        super().__init__(signal=signal)
        self.inner = self.inner_class(signal=signal)
        self.reads = self.reads_around(self.inner.reads)
        self.constants = self.inner.constants

    @classmethod
    def unavailable(cls) -> str | None:
        return cls.inner_class.unavailable()

    def prepare(self, precision: torch.dtype = torch.float32) -> None:
        self.inner.prepare(precision)
        super().prepare(precision)


A = TypeVar("A", bound=Around)


@cache
def around(wrapper: type[A], kind: type[Denoiser]) -> type[A]:
    """The class of denoisers of `kind` with what `wrapper` does to their output."""

    class AroundKind(wrapper):  # type: ignore[misc, valid-type]
        inner_class = kind
        reads = wrapper.reads_around(kind.reads)
        signal = kind.signal
        refuses = kind.refuses
        is_network = kind.is_network
        offline = kind.offline

    return AroundKind


def inner_denoiser(denoiser: Denoiser) -> Denoiser:
    """The denoiser without what is done to its output."""
    while isinstance(denoiser, Around):
        denoiser = denoiser.inner
    return denoiser
