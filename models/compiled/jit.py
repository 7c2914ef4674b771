"""How Numba compiles kernels, and on how many threads they run."""

import functools
import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from provenance import code_digest

KERNEL_FOLDER = Path(__file__).parent
# Numba recompiles a kernel when its file changes, but not when another does that it takes functions or numbers from. So
# the cache's folder is named by a digest of the sources of all kernels.
KERNELS = code_digest(*(f"models.compiled.{file.stem}" for file in sorted(KERNEL_FOLDER.glob("*.py"))))
os.environ.setdefault("NUMBA_CACHE_DIR", str(KERNEL_FOLDER / "__pycache__" / f"kernels-{KERNELS[:16]}"))

import numba  # noqa: E402 - reads the folder when it is imported

# For functions that kernels call, by which roundings LLVM may change: "contract", round a product and a sum once;
# "nsz", lose the sign of zero; "arcp", multiply by a reciprocal instead of dividing; "reassoc", add up in any order,
# which lets it vectorise sums. None of them may assume that numbers are finite.

Function = TypeVar("Function", bound=Callable[..., object])


def without_memory(*fastmath: str, inline: bool = False) -> Callable[[Function], Function]:
    """A decorator for functions that allocate nothing.

    Numba does not count references to their arguments, which would take longer than most of them. They must not return
    arrays to functions that do allocate.
    """
    options: dict[str, Any] = {"fastmath": set(fastmath), "forceinline": inline, "_nrt": False}
    decorator: Any = numba.njit(error_model="numpy", boundscheck=False, **options)
    return decorator


jit_inlined = numba.njit(inline="always", fastmath={"contract"}, error_model="numpy")
jit_in_order = without_memory("contract", "nsz")
jit_with_reciprocals = without_memory("contract", "nsz", "arcp", inline=True)
jit_in_any_order = without_memory("contract", "nsz", "arcp", "reassoc")
jit_inlined_in_any_order = without_memory("contract", "nsz", "arcp", "reassoc", inline=True)
jit_with_memory = numba.njit(error_model="numpy", boundscheck=False)  # for functions that allocate
# For the kernels themselves, which alone are kept on disk, with all that they call. The index of a prange is unsigned:
# take np.int64(row) before anything is subtracted from it.
jit_parallel = numba.njit(cache=True, parallel=True, error_model="numpy")


def array(tensor: Tensor) -> NDArray[np.float32]:
    """A tensor's values as a contiguous numpy array of float32, without a copy where it is that already."""
    return tensor.detach().float().contiguous().numpy()


def run_items(
    kernel: Callable[..., None], outputs: Sequence[Tensor], inputs: Iterable[Tensor | Sequence[Tensor]], *settings: Any
) -> None:
    """Run a kernel on each item of a batch: on arrays of the `outputs`, to fill, and of the `inputs`, as tuples too."""
    inputs = tuple(inputs)
    for item in range(len(outputs[0])):
        given = (
            array(each[item]) if isinstance(each, Tensor) else tuple(array(tensor[item]) for tensor in each)
            for each in inputs
        )
        kernel(*(output[item].numpy() for output in outputs), *given, *settings)


@jit_parallel
def nothing() -> None:
    for _ in numba.prange(2):
        pass


@functools.cache
def start_threads() -> None:
    """Start Numba's threads. They share PyTorch's OpenMP, which that sets to all cores: set it back."""
    count = torch.get_num_threads()
    numba.set_num_threads(1)
    nothing()
    torch.set_num_threads(count)


def match_threads() -> None:
    """Let Numba use as many threads as PyTorch, for the parallel kernel that comes next."""
    start_threads()
    numba.set_num_threads(min(torch.get_num_threads(), numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
