"""A denoiser to run, described before anything is built: which, with what weights, and how it computes."""

import re
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import torch

from datasets.frame import Signal
from errors import BadInput
from models import compiled, registry
from models.denoiser import Denoiser
from models.extra_denoisers import EXTRA, WINDOW_SETS, windows_label
from models.weights import load_weights
from models.wrappers.wrapper import inner_denoiser

PRECISIONS = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}

# Where the parts of a name are defined.
AROUND = {
    registry.ADAPTIVE: "models.wrappers.adaptive",
    registry.TAA: "models.wrappers.taa",
    registry.SHRINKING: "models.wrappers.shrinkage",
}
OF_BUDGET = re.compile(r"([^@+]+)@([^@+]+)(\+.*)?")  # NAME@BUDGET


def split_name(name: str) -> tuple[str, str | None]:
    """A denoiser, and the budget whose weights it is to have: wskp6+taa and quick of "wskp6@quick+taa"."""
    match = OF_BUDGET.fullmatch(name)
    return (match[1] + (match[3] or ""), match[2]) if match else (name, None)


def with_budget(name: str, budget: str) -> str:
    """The same the other way round."""
    plain = registry.plain_name(name)
    return f"{plain}@{budget}{name.removeprefix(plain)}"


def class_of(name: str) -> type[Denoiser]:
    """The class of a denoiser, which knows all that can be asked of it. Raises BadInput for an unknown name."""
    denoiser, budget = split_name(name)
    kind = EXTRA[denoiser].kind if denoiser in EXTRA else registry.denoiser_class(denoiser)
    if budget and (denoiser in EXTRA or not kind.is_network):
        raise BadInput(f"unknown denoiser '{name}': '{denoiser}' has no weights of a budget")
    return kind


def create_any(name: str, signal: Signal | None = None) -> Denoiser:
    """A denoiser of the registry or of EXTRA, with fresh weights. Raises BadInput for an unknown name."""
    denoiser, _ = split_name(name)
    if denoiser in EXTRA:
        return EXTRA[denoiser].kind(signal=signal, **EXTRA[denoiser].arguments)
    return registry.create(denoiser, signal)


def precisions_of(name: str) -> list[str]:
    """The precisions that a denoiser computes in, keys of PRECISIONS."""
    return [precision for precision, dtype in PRECISIONS.items() if dtype not in class_of(name).refuses]


def precision_in_use(name: str) -> str:
    """The fastest precision here of those that the denoiser computes in, a key of PRECISIONS."""
    fastest = registry.inference_precision(class_of(name))
    return next(precision for precision, dtype in PRECISIONS.items() if dtype == fastest)


@dataclass(frozen=True)
class DenoiserSpec:
    """One way to run a denoiser.

    Attributes:
        name: one of the registry or of EXTRA, or NAME@BUDGET: a network as it was trained in a budget, where NAME
            alone has shipped weights. Suffixes come last: wskp6@quick+adaptive.
        signal: what it returns; None for what it usually does.
        precision: of its network, a key of PRECISIONS.
        weights: the file of a network's weights; without one they are fresh, and always the same.
        compiled: by compiled kernels where there are any, or all in PyTorch.
        device: "cpu" or "cuda".
    """

    name: str
    signal: Signal | None = None
    precision: str = "float32"
    weights: Path | None = None
    compiled: bool = True
    device: str = "cpu"

    @property
    def kind(self) -> type[Denoiser]:
        return class_of(self.name)

    @property
    def returns(self) -> Signal:
        """The signal that it returns."""
        return self.signal or self.kind.signal

    @property
    def way(self) -> str:
        """Its name in the bench's tables, which tell precisions apart by a column of their own: svgf (PyTorch)."""
        signal = f" ({self.returns})" if self.returns != self.kind.signal else ""
        return f"{self.name}{signal}" + ("" if self.compiled else " (PyTorch)")

    @property
    def label(self) -> str:
        """Its name in the trade, and of the folder of its results there: rae-bfloat16."""
        return self.name if self.precision == "float32" else f"{self.name}-{self.precision}"

    @property
    def modules(self) -> tuple[str, ...]:
        """Those of onespp in which the denoiser is defined."""
        around = [module for suffix, module in AROUND.items() if suffix in self.name]
        return (class_of(registry.plain_name(self.name)).__module__, *around)

    def build(self) -> Denoiser:
        """Ready to use. Raises BadInput where it cannot run here, or its weights are damaged or another network's."""
        torch.manual_seed(0)
        denoiser = create_any(self.name, self.signal)
        if self.weights:
            name, _ = split_name(self.name)
            label = windows_label(WINDOW_SETS[name]) if name in WINDOW_SETS else registry.plain_name(name)
            load_weights(inner_denoiser(denoiser), label, self.weights)
        denoiser.prepare(PRECISIONS[self.precision])
        return denoiser.to(self.device)

    def running(self) -> AbstractContextManager[None]:
        """The context in which it computes as described."""
        return nullcontext() if self.compiled else compiled.disabled()
