"""Which code and packages have made a training: weights and checkpoints name them."""

from collections.abc import Sequence
from typing import Any

from provenance import code_digest, versions
from train.losses.network_loss import NetworkLoss

TRAINING_PACKAGES = ("torch", "numpy", "numba", "lightning-fabric")  # that training computes with

MadeBy = dict[str, Any]  # {"versions": {package: version}, "code": digest}
UNKNOWN: MadeBy = {"versions": {}, "code": None}  # of checkpoints from before they named it


def maker_here(loss: NetworkLoss) -> MadeBy:
    """The packages installed here and the code of the training loop, of the network and of its loss."""
    code = code_digest("train.loop", type(loss).__module__, type(loss.denoiser).__module__)
    return {"versions": versions(TRAINING_PACKAGES), "code": code}


def other_makers(makers: Sequence[MadeBy], here: MadeBy) -> str:
    """What made a training and is not here, such as "other code, torch 2.12.0 (now 2.13.0)"; empty if nothing is."""
    found: dict[str, None] = {}  # an ordered set
    for maker in makers:
        if maker == UNKNOWN:
            found["older code"] = None
            continue
        if maker["code"] != here["code"]:
            found["other code"] = None
        for package in TRAINING_PACKAGES:
            then = maker["versions"].get(package, "none")
            now = here["versions"].get(package, "none")
            if then != now:
                found[f"{package} {then} (now {now})"] = None
    return ", ".join(found)
