"""Kernels compiled at first use: fast versions of functions that models/ has in PyTorch.

`by` puts a kernel beside the PyTorch function of the same name and signature, whose docstring is for both, and decides
which of them runs. Numba compiles kernels for the CPU and keeps them on disk from run to run. `with_gradients` is for
kernels with gradients of their own. What no kernel can compute (other gradients, half precision, nearly everything on
GPUs) runs in PyTorch; tests hold kernels to that.

The constants of a paper stand at the top of its kernel file, as Python numbers, from where the PyTorch version takes
them; kernels round them with `f32`. Limits that several share are in models.operators.
"""

import contextlib
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
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


def kernel_device(tensors: Sequence[Tensor]) -> str | None:
    """The type of device whose kernels can run on the tensors ("cpu", "cuda"); None where PyTorch must.

    Kernels have no gradients and take images in float32, of which the first tensor is one.
    """
    differentiates = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    if not enabled or differentiates or tensors[0].dtype != torch.float32:
        return None
    types = {tensor.device.type for tensor in tensors}
    return types.pop() if len(types) == 1 else None


def with_gradients(image: Tensor) -> bool:
    """Whether kernels with gradients of their own can run on an image; then on as many threads as PyTorch."""
    possible = enabled and image.device.type == "cpu" and image.dtype == torch.float32
    if possible:
        match_threads()
    return possible


def by(cpu: Callable[P, R], gpu: Callable[P, R] | None = None) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """A decorator that runs kernels in place of a PyTorch function wherever they can: see `kernel_device`.

    `cpu` and `gpu` have the function's signature and return the same, but for rounding.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def choose(*args: P.args, **kwargs: P.kwargs) -> R:
            device = kernel_device([*tensors_among((*args, *kwargs.values()))])
            if device == "cpu":
                match_threads()
                return cpu(*args, **kwargs)
            if device == "cuda" and gpu is not None:
                return gpu(*args, **kwargs)
            return function(*args, **kwargs)

        return choose

    return decorate
