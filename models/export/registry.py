"""The denoisers that can be exported, by name."""

from pathlib import Path

import torch

from errors import BadInput
from models.denoiser import Denoiser
from models.export.one import OneStep
from models.export.step import Step, Warp
from models.export.wskp import WSKPStep
from models.spec import load

STEPS = {"wskp3": WSKPStep, "wskp6": WSKPStep, "one": OneStep}


def check_exportable(name: str) -> None:
    """Raises BadInput for the name of a denoiser that has no step."""
    if name not in STEPS:
        raise BadInput(f"'{name}' cannot be exported; {', '.join(STEPS)} can")


def step_of(name: str, denoiser: Denoiser, warp: Warp) -> Step:
    """The step of a named denoiser, which is prepared for inference and must not be used any more."""
    check_exportable(name)
    return STEPS[name](denoiser, warp)


def load_step(name: str, weights: Path, precision: torch.dtype, warp: Warp) -> Step:
    """A denoiser's step with the weights of a file. Raises BadInput where it has none, or the file is not its own."""
    return step_of(name, load(name, weights, precision), warp)
