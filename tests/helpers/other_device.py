"""A second device for machines without a GPU: tensors on "other" compute on the CPU, but do not mix with CPU tensors.

As with CUDA, an operator whose tensors are on different devices raises RuntimeError, and so does `numpy()`; only single
numbers (0-dimensional CPU tensors) may enter elementwise operators, and indices may stay on the CPU.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.backend_registration import _setup_privateuseone_for_python_backend

NAME = "other"
aten = torch.ops.aten
MIXING = {aten.copy_.default, aten._to_copy.default}
INDEXING = {aten.index.Tensor, aten.index_put_.default}


class Other(Tensor):
    """A tensor on the other device; its numbers are in `inner`, on the CPU."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "Other":
        layout = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        self: Other = Tensor._make_wrapper_subclass(cls, inner.size(), device=torch.device(NAME, 0), **layout)
        self.inner = inner
        return self

    def __repr__(self) -> str:
        return f"Other({self.inner})"

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(func, args, kwargs or {})


class Factories(TorchDispatchMode):
    """Lets operators make tensors on the other device, or copy them there."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(func, args, kwargs or {})


def mapped(function: Callable[[Tensor], Any], value: Any) -> Any:
    """An operator's argument or result with `function` of each of its tensors."""
    if isinstance(value, list | tuple):
        return type(value)(mapped(function, item) for item in value)
    return function(value) if isinstance(value, Tensor) else value


def compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """The result of an operator: on the device that it names, else on that of its tensors."""
    with Factories():
        result = func.decompose(*args, **kwargs)  # inference mode leaves that to the interceptor
        if result is not NotImplemented:
            return result
    if func is aten._has_compatible_shallow_copy_type.default:  # what modules ask whose parameters are moved
        return type(args[0]) is type(args[1])
    tensors: list[Tensor] = []
    for value in (*args, *kwargs.values()):
        mapped(tensors.append, value)
    check_devices(func, args, tensors)
    device = kwargs.get("device")
    if device is not None:
        kwargs = kwargs | {"device": torch.device("cpu")}
    result = func(*mapped(inner_of, args), **{key: mapped(inner_of, value) for key, value in kwargs.items()})
    if func._schema.is_mutable:
        return kwargs.get("out", args[0])
    on_other = device.type == NAME if device is not None else any(isinstance(tensor, Other) for tensor in tensors)
    return mapped(Other, result) if on_other else result


def check_devices(func: Any, args: Any, tensors: list[Tensor]) -> None:
    """Raise RuntimeError where an operator's tensors are on two devices."""
    strangers = [tensor for tensor in tensors if not isinstance(tensor, Other)]
    if len(strangers) in (0, len(tensors)) or func in MIXING or (func in INDEXING and isinstance(args[0], Other)):
        return
    if any(tensor.dim() > 0 or torch.Tag.pointwise not in func.tags for tensor in strangers):
        raise RuntimeError(f"{func}: expected all tensors to be on the same device, but found {NAME} and cpu")


def inner_of(tensor: Tensor) -> Tensor:
    return tensor.inner if isinstance(tensor, Other) else tensor


@cache
def register() -> None:
    _setup_privateuseone_for_python_backend(NAME)


@contextmanager
def other_device() -> Iterator[str]:
    """A context with the other device, whose name it yields."""
    register()
    before = torch._C._only_lift_cpu_tensors()
    torch._C._set_only_lift_cpu_tensors(True)  # torch.tensor(..., device=...) makes a CPU tensor and copies it
    try:
        with Factories():
            yield NAME
    finally:
        torch._C._set_only_lift_cpu_tensors(before)
