"""Which code and packages have made a training: weights and checkpoints name them."""

from collections.abc import Sequence
from typing import Any

from provenance import code_digest, versions
from train.losses.network_loss import NetworkLoss

PACKAGES = ("torch", "numpy", "numba", "lightning-fabric")  # that training computes with

Maker = dict[str, Any]  # {"versions": {package: version}, "code": digest}
UNKNOWN: Maker = {"versions": {}, "code": None}  # of what was written before makers were


def maker_here(loss: NetworkLoss) -> Maker:
    """The packages installed here and the code of the training loop, of the network and of its loss."""
    code = code_digest("train.training", type(loss).__module__, type(loss.denoiser).__module__)
    return {"versions": versions(PACKAGES), "code": code}


def other_makers(makers: Sequence[Maker], here: Maker) -> str:
    """What made a training and is not here, in words, such as "other code, torch 2.12.0"; empty if nothing is."""
    found: dict[str, None] = {}  # an ordered set
    for maker in makers:
        if maker == UNKNOWN:
            found["older code"] = None
            continue
        if maker["code"] != here["code"]:
            found["other code"] = None
        for package, version in maker["versions"].items():
            if here["versions"].get(package) != version:
                found[f"{package} {version}"] = None
    return ", ".join(found)
