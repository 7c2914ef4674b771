"""The denoisers and wrappers that have names, such as wskp6@quick+adaptive+js: denoiser, training, wrappers."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch

from datasets.frame import Signal
from errors import BadInput
from models.denoiser import Denoiser
from models.filters.aaf import AAF
from models.filters.asvgf import ASVGF
from models.filters.baselines import Accumulated, Noisy
from models.filters.bmfr import BMFR
from models.filters.eaw import EAW
from models.filters.nfor import NFOR
from models.filters.oidn import OIDN, OIDNAccumulated, OIDNBalanced, OIDNFast, OIDNIrradiance
from models.filters.sbf import SBF
from models.filters.svgf import SVGF
from models.filters.trmv import TRMV
from models.networks.lbf import LBF
from models.networks.nbgd import NBGD
from models.networks.ntd import NTD, NTDMean, NTDTraditional
from models.networks.one import One
from models.networks.rae import RAE
from models.networks.wskp import KP, MRKP, WSKP, WSKP3, WSKPMR
from models.wrappers.adaptive import AccumulatedAfter, Adaptive
from models.wrappers.shrinkage import JamesStein
from models.wrappers.taa import TAA
from models.wrappers.wrapper import Wrapper

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
    "oidn-balanced": OIDNBalanced,
    "oidn-fast": OIDNFast,
    "oidn-irradiance": OIDNIrradiance,
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
WRAPPERS: dict[str, type[Wrapper]] = {
    "accumulated": AccumulatedAfter,
    "adaptive": Adaptive,
    "taa": TAA,
    "js": JamesStein,
}
SHIPPED_FOLDER = Path(__file__).parent / "shipped"  # a file a network, beside its card
SYNTAX = re.compile(r"([^@+]+)(?:@([^@+]+))?((?:\+[^@+]+)*)")


@dataclass(frozen=True)
class DenoiserName:
    """A name in its parts; `str` returns the name."""

    base: str  # a key of DENOISERS, which is also what its weights are called
    budget: str | None = None  # the training budget of its weights, kept in RUNS; None for the weights that are shipped
    wrappers: tuple[str, ...] = ()  # keys of WRAPPERS, innermost first

    def __str__(self) -> str:
        return "+".join([f"{self.base}@{self.budget}" if self.budget else self.base, *self.wrappers])


def create(name: str | DenoiserName, signal: Signal | None = None) -> Denoiser:
    """A denoiser by its name, with fresh weights if it is a network; `signal` is by default that of its class.

    Raises BadInput for an unknown name, and for a wrapper that does not fit the denoiser.
    """
    name = parse_name(name)
    denoiser = DENOISERS[name.base](signal=signal)
    for wrapper in name.wrappers:
        denoiser = WRAPPERS[wrapper](denoiser)
    return denoiser


@cache
def prototype(name: str | DenoiserName) -> Denoiser:
    """A denoiser without weights, to read its attributes from; it cannot run. Raises BadInput as `create`."""
    with torch.device("meta"):
        return create(name)


def parse_name(name: str | DenoiserName) -> DenoiserName:
    """A name BASE[@BUDGET][+WRAPPER...] in its parts. Raises BadInput for one of no denoiser."""
    parsed = name
    if isinstance(parsed, str):
        match = SYNTAX.fullmatch(parsed)
        if not match:
            raise BadInput(f"'{name}' is no name of a denoiser: write NAME, NAME@BUDGET or NAME+WRAPPER")
        parsed = DenoiserName(match[1], match[2], tuple(match[3].split("+")[1:]))
    if parsed.base not in DENOISERS or not WRAPPERS.keys() >= {*parsed.wrappers}:
        raise BadInput(
            f"unknown denoiser '{name}'; the denoisers are {', '.join(DENOISERS)}, each also with "
            "+accumulated, +taa and +js, and those that filter `accumulated` with +adaptive"
        )
    if parsed.budget and not DENOISERS[parsed.base].is_network:
        raise BadInput(f"unknown denoiser '{name}': '{parsed.base}' has no weights, and so no @{parsed.budget}")
    return parsed


def channels_read(names: Sequence[str] = ()) -> tuple[str, ...]:
    """The channels that the named denoisers read, or all denoisers. Raises BadInput for an unknown name."""
    return tuple(sorted({channel for name in names or DENOISERS for channel in prototype(name).reads}))


def shipped_weights(name: str) -> Path | None:
    """The shipped weights of a denoiser of the registry; None where there are none."""
    path = SHIPPED_FOLDER / f"{name}.safetensors"
    return path if path.exists() else None


def require_shipped(name: str) -> Path:
    """The same; raises BadInput where there are none."""
    path = shipped_weights(name)
    if path is None:
        raise BadInput(f"no weights of '{name}' are shipped; those are {', '.join(shipped_names()) or 'none'}")
    return path


def shipped_names() -> list[str]:
    """The networks whose weights are shipped, in the order of the registry."""
    return [name for name in DENOISERS if shipped_weights(name)]
