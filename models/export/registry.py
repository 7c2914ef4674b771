"""Which denoisers can be exported."""

from pathlib import Path

import torch

from errors import BadInput
from models.denoiser import Denoiser
from models.export.one import OneStep
from models.export.step import Step, Warp
from models.export.wskp import WSKPStep
from models.networks.one import One
from models.networks.wskp import WSKP
from models.registry import DENOISERS, prototype
from models.spec import load

EXPORT_STEPS: dict[type[Denoiser], type[Step]] = {WSKP: WSKPStep, One: OneStep}  # by class, subclasses included
EXPORTABLE = [name for name, kind in DENOISERS.items() if issubclass(kind, tuple(EXPORT_STEPS))]


def check_exportable(name: str) -> None:
    """Raise BadInput for the name of a denoiser that has no step."""
    if not isinstance(prototype(name), tuple(EXPORT_STEPS)):
        raise BadInput(f"'{name}' cannot be exported; {', '.join(EXPORTABLE)} can")


def step_of(denoiser: Denoiser, warp: Warp) -> Step:
    """The step of a denoiser, which is prepared for inference and must not be used afterwards."""
    return next(step for kind, step in EXPORT_STEPS.items() if isinstance(denoiser, kind))(denoiser, warp)


def load_step(name: str, weights: Path, precision: torch.dtype, warp: Warp) -> Step:
    """The step of a named denoiser with the weights of a file. Raises BadInput where either does not fit."""
    check_exportable(name)
    return step_of(load(name, weights, precision), warp)
