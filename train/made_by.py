"""Which code and packages a training ran with: weights and checkpoints name them."""

from collections.abc import Sequence
from typing import TypedDict

from provenance import code_digest, versions
from train.losses.network_loss import NetworkLoss

TRAINING_PACKAGES = ("torch", "numpy", "numba", "lightning-fabric")  # that training computes with


class MadeBy(TypedDict):
    versions: dict[str, str]  # by package
    code: str  # its digest


def made_by_here(loss: NetworkLoss) -> MadeBy:
    """The packages installed here and the code of the training loop, of the network and of its loss."""
    code = code_digest("train.loop", type(loss.loss).__module__, type(loss.denoiser).__module__)
    return {"versions": versions(TRAINING_PACKAGES), "code": code}


def differences(recorded: Sequence[MadeBy], here: MadeBy) -> str:
    """How what a training ran with differs from here, "other code, torch 2.12.0 (now 2.13.0)"; empty if it does not."""
    changes: dict[str, None] = {}  # an ordered set
    for made_by in recorded:
        if made_by["code"] != here["code"]:
            changes["other code"] = None
        for package in TRAINING_PACKAGES:
            then, now = (each["versions"].get(package, "none") for each in (made_by, here))
            if then != now:
                changes[f"{package} {then} (now {now})"] = None
    return ", ".join(changes)
