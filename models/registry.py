"""The denoisers that have names."""

from collections.abc import Sequence
from pathlib import Path

import torch

from datasets.frame import Signal
from errors import BadInput
from models.denoiser import Denoiser
from models.fastest import bfloat16_pays
from models.filters.aaf import AAF
from models.filters.asvgf import ASVGF
from models.filters.baselines import Accumulated, Noisy
from models.filters.bmfr import BMFR
from models.filters.eaw import EAW
from models.filters.nfor import NFOR
from models.filters.oidn import OIDN, OIDNAccumulated
from models.filters.sbf import SBF
from models.filters.svgf import SVGF
from models.filters.trmv import TRMV
from models.networks.lbf import LBF
from models.networks.nbgd import NBGD
from models.networks.ntd import NTD, NTDMean, NTDTraditional
from models.networks.one import One
from models.networks.rae import RAE
from models.networks.wskp import KP, MRKP, WSKP, WSKP3, WSKPMR
from models.weights import load_weights
from models.wrappers.adaptive import adaptive
from models.wrappers.shrinkage import Shrunk
from models.wrappers.taa import Antialiased
from models.wrappers.wrapper import around, inner_denoiser

TAA = "+taa"
ADAPTIVE = "+adaptive"
SHRINKING = "+js"
DENOISERS: dict[str, type[Denoiser]] = {
    "noisy": Noisy,
    "accumulated": Accumulated,
    "eaw": EAW,
    "svgf": SVGF,
    "asvgf": ASVGF,
    "trmv": TRMV,
    "bmfr": BMFR,
    "aaf": AAF,
    "sbf": SBF,
    "nfor": NFOR,
    "oidn": OIDN,
    "oidn-accumulated": OIDNAccumulated,
    "rae": RAE,
    "wskp3": WSKP3,
    "wskp6": WSKP,
    "wskp-mr": WSKPMR,
    "kp": KP,
    "mr-kp": MRKP,
    "nbgd": NBGD,
    "lbf": LBF,
    "ntd-a": NTDTraditional,
    "ntd-b": NTD,  # trained without the occlusion loss
    "ntd": NTD,
    "ntd-mean": NTDMean,
    "one": One,
}


def plain_name(name: str) -> str:
    """The name of the denoiser alone, without what is done before and after it: what its weights are called."""
    return name.partition("+")[0]


def denoiser_class(name: str) -> type[Denoiser]:
    """The class of a denoiser, which tells what it reads and refuses. Raises BadInput for an unknown name.

    A name that ends in "+adaptive" means that denoiser on adaptively accumulated frames, which is another BadInput
    where it does not accumulate; one that ends in "+taa", with temporal antialiasing after it; and one that ends in
    "+js", with shrinkage last of all.
    """
    if name.endswith(SHRINKING):
        return around(Shrunk, denoiser_class(name.removesuffix(SHRINKING)))  # type: ignore[arg-type]  # classes are hashable
    if name.endswith(TAA):
        return around(Antialiased, denoiser_class(name.removesuffix(TAA)))  # type: ignore[arg-type]
    if name.endswith(ADAPTIVE):
        return adaptive(denoiser_class(name.removesuffix(ADAPTIVE)))  # type: ignore[arg-type]
    if name not in DENOISERS:
        raise BadInput(
            f"unknown denoiser '{name}'; the denoisers are {', '.join(DENOISERS)}, each also with {TAA} "
            f"and {SHRINKING}, and those that accumulate with {ADAPTIVE}"
        )
    return DENOISERS[name]


def create(name: str, signal: Signal | None = None) -> Denoiser:
    """A denoiser by its name, with fresh weights if it is a network. Raises BadInput for an unknown name.

    `signal` is what it returns, by default that of its class.
    """
    return denoiser_class(name)(signal=signal)


def unavailable(name: str) -> str | None:
    """Why a denoiser cannot run on this machine, with what to install; None where it can."""
    return denoiser_class(name).unavailable()


def channels_read(names: Sequence[str] = ()) -> tuple[str, ...]:
    """The channels that the named denoisers read, or all denoisers. Raises BadInput for an unknown name."""
    return tuple(sorted({channel for name in names or DENOISERS for channel in denoiser_class(name).reads}))


def load(
    name: str, weights: Path | None, precision: torch.dtype | None = None, signal: Signal | None = None
) -> Denoiser:
    """A denoiser ready to use: with the weights of the file if it is a network, in the form for inference.

    `precision` is by default the fastest here of those that it does not refuse, `signal` that of its class.
    Raises BadInput where the file is missing, damaged or of another network, and for a precision it refuses.
    """
    denoiser = create(name, signal)
    if denoiser.is_network:
        if weights is None:
            raise BadInput(f"'{name}' needs trained weights")
        load_weights(inner_denoiser(denoiser), plain_name(name), weights)
    denoiser.prepare(precision or inference_precision(name))
    return denoiser


def inference_precision(denoiser: type[Denoiser] | str) -> torch.dtype:
    """bfloat16 for networks that take it, where this processor is faster in it, else float32.

    `denoiser` is a class or a name. Raises BadInput for an unknown name.
    """
    kind = denoiser_class(denoiser) if isinstance(denoiser, str) else denoiser
    takes = kind.is_network and torch.bfloat16 not in kind.refuses
    return torch.bfloat16 if takes and bfloat16_pays() else torch.float32
