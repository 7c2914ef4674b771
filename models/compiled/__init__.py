"""Kernels compiled at first use: fast versions of functions that models/ has in PyTorch.

`by` puts a kernel beside the PyTorch function of the same name and signature, whose docstring is for both, and decides
which of them runs; where kernels have gradients of their own, `usable` does. Numba compiles kernels for the CPU and
keeps them on disk from run to run. What no kernel can compute (other gradients, half precision, anything on GPUs) runs
in PyTorch; tests hold kernels to that.

The constants of a paper stand at the top of its kernel file, as Python numbers, from where the PyTorch version takes
them; kernels round them with `f32`. Limits that several share are in models.operators.
"""

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator
from typing import ParamSpec, TypeVar

import torch
from torch import Tensor, nn

from models.compiled.jit import match_threads

P = ParamSpec("P")
R = TypeVar("R")

enabled = True


@contextlib.contextmanager
def disabled() -> Iterator[None]:
    """Run PyTorch within the context: for tests and benches."""
    global enabled
    before = enabled
    enabled = False
    try:
        yield
    finally:
        enabled = before


def tensors_among(values: Iterable[object]) -> Iterator[Tensor]:
    """The values that are tensors, those in lists and tuples, and the parameters of modules."""
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, nn.Module):
            yield from value.parameters()
        elif isinstance(value, list | tuple):
            yield from tensors_among(value)


def usable(image: Tensor) -> bool:
    """Whether kernels can run on an image; then on as many threads as PyTorch."""
    possible = enabled and image.device.type == "cpu" and image.dtype == torch.float32
    if possible:
        match_threads()
    return possible


def by(kernel: Callable[P, R]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A decorator that runs a kernel in place of a PyTorch function wherever it can.

    The kernel has the function's signature and returns the same, but for rounding. It has no gradients, and takes
    tensors on the CPU, of which the first is an image in float32.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def choose(*args: P.args, **kwargs: P.kwargs) -> R:
            tensors = [*tensors_among((*args, *kwargs.values()))]
            differentiates = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
            if differentiates or any(tensor.device.type != "cpu" for tensor in tensors) or not usable(tensors[0]):
                return function(*args, **kwargs)
            return kernel(*args, **kwargs)

        return choose

    return decorate
