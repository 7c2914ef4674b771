"""Kernels that Numba compiles for the processor at first use: the fast way of what models/ also says in PyTorch.

They need no compiler, are kept on disk from run to run, and serve inference on CPUs. Everything else (gradients, half
precision, and GPUs but for fusion_triton.py) takes the PyTorch way, which the tests hold them to.
"""

import contextlib
import functools
from collections.abc import Iterator

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

enabled = True

# Inputs are finite, and sums may be taken in any order.
jit = numba.njit(cache=True, fastmath={"contract", "arcp", "reassoc", "nsz"}, error_model="numpy", boundscheck=False)
# Numba counts rows of a prange without a sign: np.int64(row), before anything is subtracted from it.
jit_parallel = numba.njit(cache=True, parallel=True, error_model="numpy")


@contextlib.contextmanager
def disabled() -> Iterator[None]:
    """Take the PyTorch way within the context: for tests and benches."""
    global enabled
    before, enabled = enabled, False
    try:
        yield
    finally:
        enabled = before


def usable(*tensors: Tensor) -> bool:
    """Whether compiled kernels can work on the tensors: float32 on a CPU, without gradients."""
    plain = all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors)
    return enabled and plain and not (torch.is_grad_enabled() and any(t.requires_grad for t in tensors))


def array(tensor: Tensor) -> NDArray[np.float32]:
    """A tensor's values as a contiguous numpy array, without a copy where it is contiguous."""
    return tensor.detach().contiguous().numpy()


@numba.njit(parallel=True, cache=True)
def nothing() -> None:
    for _ in numba.prange(2):
        pass


@functools.cache
def start() -> None:
    """Start Numba's threads. They share PyTorch's OpenMP, which that sets to all cores: set it back."""
    count = torch.get_num_threads()
    numba.set_num_threads(1)
    nothing()
    torch.set_num_threads(count)


def threads() -> None:
    """Let Numba use as many threads as PyTorch. Call it before a parallel kernel."""
    start()
    numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
