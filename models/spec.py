"""A denoiser to run, described before anything is built: which, with what weights, and how it computes."""

import os
import time
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from torch.nn import functional as F

from datasets.frame import Signal
from errors import BadInput
from files import cache_folder, read_json, write_json
from models import compiled
from models.denoiser import Denoiser
from models.registry import DenoiserName, create, parse_name, prototype
from models.weights import load_weights
from models.wrappers.wrapper import layers_of, unwrapped
from provenance import processor_name
from timing import take_turns, thread_count

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}
MIN_SPEEDUP = 1.1  # of bfloat16 over float32, to be used
TURNS = 7


@cache
def bfloat16_is_faster() -> bool:
    """Whether this machine convolves images faster in bfloat16 than in float32; measured once a machine, in 50 ms.

    Some processors take longer by AVX-512-BF16 instructions, where they have no matrix units, and some half as long.
    The result is kept in the user's cache folder, by processor, instruction set and version of PyTorch.
    """
    if not (torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()):
        return False
    path = cache_folder() / "bfloat16.json"
    limit = os.environ.get("ONEDNN_MAX_CPU_ISA", "all instructions")
    machine = f"{processor_name()}, {limit}, torch {torch.__version__}"
    speedups: dict[str, float] = {}
    with suppress(BadInput):  # missing or damaged: measured again
        speedups = read_json(path)
    if machine not in speedups:
        speedups[machine] = bfloat16_speedup()
        with suppress(OSError):  # a folder that cannot be written costs the next process 50 ms
            path.parent.mkdir(parents=True, exist_ok=True)
            write_json(path, speedups)
    return speedups[machine] > MIN_SPEEDUP


def bfloat16_speedup() -> float:
    """How many times faster this processor convolves in bfloat16, by the time that one thread computes, busy or not."""
    work = {}
    for dtype in (torch.float32, torch.bfloat16):
        ones = (torch.ones(shape, dtype=dtype) for shape in ((1, 32, 96, 96), (32, 32, 3, 3)))
        image, weight = (each.contiguous(memory_format=torch.channels_last) for each in ones)
        work[str(dtype)] = partial(F.conv2d, image, weight, padding=1)
    with thread_count(1), torch.no_grad():
        seconds = take_turns(work, TURNS, clock=time.thread_time, label=None)
    return min(seconds[str(torch.float32)]) / min(seconds[str(torch.bfloat16)])


def precisions_of(name: str | DenoiserName) -> list[str]:
    """The precisions that a denoiser computes in, keys of PRECISIONS. Raises BadInput for an unknown name."""
    return [precision for precision, dtype in PRECISIONS.items() if dtype not in prototype(name).refuses]


def fastest_precision(name: str | DenoiserName, device: str = "cpu") -> str:
    """bfloat16 for networks that support it, where the device is faster in it, else float32, which C computes in.

    Raises BadInput for an unknown name, or where there is no such device.
    """
    check_device(device)
    if not prototype(name).is_network or "bfloat16" not in precisions_of(name):
        return "float32"
    if device == "cpu" and unwrapped(prototype(name)).c_digest():
        return "float32"
    is_faster = bfloat16_is_faster() if device == "cpu" else torch.cuda.is_bf16_supported(including_emulation=False)
    return "bfloat16" if is_faster else "float32"


def check_device(device: str) -> None:
    """Raise BadInput for the name of no device, and for "cuda" or "cuda:0" where PyTorch finds no CUDA device."""
    try:
        kind = torch.device(device).type
    except RuntimeError:
        raise BadInput(f"there is no device '{device}': use cpu or cuda") from None
    if kind == "cuda" and not torch.cuda.is_available():
        raise BadInput("PyTorch finds no CUDA device here: use the device cpu")


@dataclass(frozen=True)
class DenoiserSpec:
    """One way to run a denoiser."""

    denoiser: DenoiserName  # its name, in its parts
    signal: Signal | None = None  # what it returns; None for what it usually does
    precision: str = "float32"  # of its network, a key of PRECISIONS
    weights: Path | None = None  # the file of a network's weights; without one they are fresh, and always the same
    compiled: bool = True  # by compiled kernels where there are any, or all in PyTorch
    device: str = "cpu"  # "cpu" or "cuda"

    @classmethod
    def named(cls, name: str, **fields: Any) -> "DenoiserSpec":
        """That of a name such as wskp6@quick+taa. Raises BadInput for one of no denoiser."""
        return cls(parse_name(name), **fields)

    @property
    def name(self) -> str:
        return str(self.denoiser)

    @property
    def facts(self) -> Denoiser:
        """A denoiser of this kind to read attributes from, see registry.prototype."""
        return prototype(self.denoiser)

    @property
    def returns(self) -> Signal:
        """The signal that it returns."""
        return self.signal or self.facts.signal

    @property
    def way(self) -> str:
        """Its name in the bench's tables, where weights make no difference: svgf (PyTorch)."""
        signal = f" ({self.returns})" if self.returns != self.facts.signal else ""
        return f"{replace(self.denoiser, budget=None)}{signal}" + ("" if self.compiled else " (PyTorch)")

    @property
    def label(self) -> str:
        """Its name in the trade, and of the folder of its results there: rae-bfloat16."""
        return self.name if self.precision == "float32" else f"{self.name}-{self.precision}"

    @property
    def modules(self) -> tuple[str, ...]:
        """The modules of onespp that define the denoiser and its wrappers."""
        return tuple(type(layer).__module__ for layer in layers_of(self.facts))

    @property
    def may_use_c(self) -> bool:
        return self.compiled and self.device == "cpu" and self.precision == "float32"

    @property
    def c_digest(self) -> str | None:
        """The digest of the C code that computes in its network's place, if any."""
        return unwrapped(self.facts).c_digest() if self.may_use_c else None

    def build(self) -> Denoiser:
        """Ready to use. Raises BadInput where it cannot run here, or its weights are damaged or another network's."""
        check_device(self.device)
        torch.manual_seed(0)
        denoiser = create(self.denoiser, self.signal)
        if self.weights:
            load_weights(unwrapped(denoiser), self.denoiser.base, self.weights)
        denoiser.prepare(PRECISIONS[self.precision])
        denoiser.device = self.device
        if self.may_use_c:
            unwrapped(denoiser).use_c()
        return denoiser.to(self.device)

    def running(self) -> AbstractContextManager[None]:
        """The context in which it computes as described."""
        return nullcontext() if self.compiled else compiled.disabled()


def load(
    name: str,
    weights: Path | None,
    precision: torch.dtype | None = None,
    signal: Signal | None = None,
    device: str = "cpu",
) -> Denoiser:
    """A denoiser ready to use, by its name, with the weights of a file if it is a network.

    `precision` is by default the fastest here of those that it does not refuse, `signal` that of its class. Raises
    BadInput where the name is unknown, the file missing, damaged or another network's, and for a precision it refuses.
    """
    parsed = parse_name(name)
    if not prototype(parsed).is_network:
        weights = None
    elif weights is None:
        raise BadInput(f"'{name}' needs trained weights")
    chosen = str(precision).removeprefix("torch.") if precision else fastest_precision(parsed, device)
    if chosen not in PRECISIONS:
        raise BadInput(f"no denoiser computes in {chosen}: use one of {', '.join(PRECISIONS)}")
    return DenoiserSpec(parsed, signal, chosen, weights, device=device).build()
