"""The denoisers that have names."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch

from datasets.frame import Signal
from errors import BadInput
from models import oidn
from models.baselines import Accumulated, Noisy
from models.denoiser import Denoiser
from models.eaw import EAW
from models.ntd import NTD
from models.oidn import OIDN, OIDNAccumulated
from models.rae import RAE
from models.svgf import SVGF
from models.taa import Antialiased, unwrapped
from models.weights import load_weights
from models.wskp import KP, WSKP, WSKPMR

TAA = "+taa"
DENOISERS: dict[str, Callable[[], Denoiser]] = {
    "noisy": Noisy,
    "accumulated": Accumulated,
    "eaw": EAW,
    "svgf": SVGF,
    "oidn": OIDN,
    "oidn-accumulated": OIDNAccumulated,
    "rae": RAE,
    "wskp3": partial(WSKP, layers=3),
    "wskp6": partial(WSKP, layers=6),
    "wskp-mr": WSKPMR,
    "kp": KP,
    "ntd-a": partial(NTD, vectors="motion"),
    "ntd-b": NTD,
    "ntd": NTD,
}


# STAND-IN until the facts are the classes' own.
Denoiser.is_network = False  # type: ignore[attr-defined]
for _kind in (RAE, WSKP, WSKPMR, KP, NTD):
    _kind.is_network = True
NTD.signal = "indirect"


def denoiser_class(name: str) -> type[Denoiser]:
    plain = without_taa(name)
    if plain not in DENOISERS:
        create(plain)
    maker = DENOISERS[plain]
    return maker.func if isinstance(maker, partial) else maker  # type: ignore


def create(name: str, signal: Signal | None = None) -> Denoiser:
    denoiser = _create(name)
    if signal:
        denoiser.signal = signal
    return denoiser


def _create(name: str) -> Denoiser:
    """A denoiser by its name, with fresh weights where it has any. Raises BadInput for an unknown name.

    A name that ends in "+taa" means that denoiser with temporal antialiasing after it.
    """
    if name.endswith(TAA):
        return Antialiased(_create(without_taa(name)))
    if name not in DENOISERS:
        raise BadInput(f"unknown denoiser '{name}'; the denoisers are {', '.join(DENOISERS)}, each also with {TAA}")
    return DENOISERS[name]()


def without_taa(name: str) -> str:
    """The name of the denoiser alone: what its weights are called."""
    return name.removesuffix(TAA)


def unavailable(name: str) -> str | None:
    """Why a denoiser cannot run on this machine, with what to install; None where it can."""
    return oidn.unavailable() if isinstance(create(without_taa(name)), OIDN) else None


def channels_read(names: Sequence[str] = ()) -> tuple[str, ...]:
    """The channels that the named denoisers read, or all denoisers. Raises BadInput for an unknown name."""
    return tuple(sorted({channel for name in names or DENOISERS for channel in create(name).reads}))


def load(name: str, weights: Path | None, precision: torch.dtype | None = None) -> Denoiser:
    """A denoiser ready to use: with the weights of the file if it has any, in the form for inference.

    `precision` is by default the fastest here of those that it does not refuse.
    Raises BadInput where the file is missing, damaged or of another network, and for a precision it refuses.
    """
    denoiser = create(name)
    if denoiser.parameter_count():
        if weights is None:
            raise BadInput(f"'{name}' needs trained weights")
        load_weights(unwrapped(denoiser), without_taa(name), weights)
    denoiser.prepare(precision or inference_precision(denoiser))
    return denoiser


def inference_precision(denoiser: type[Denoiser] | Denoiser) -> torch.dtype:
    """bfloat16 for networks that take it, where this processor has instructions for it, else float32."""
    takes = denoiser.is_network and torch.bfloat16 not in denoiser.refuses  # type: ignore[union-attr]
    has = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    return torch.bfloat16 if takes and has else torch.float32
