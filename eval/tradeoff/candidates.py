"""The denoisers of the trade-off: all that can run and have weights, in each of their precisions."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from eval.selection import cannot_run, choose, untrained, weights_file
from models.names import DenoiserName
from models.registry import DENOISERS
from models.spec import DenoiserSpec, precisions_of
from models.weights import read_metadata


def candidates(names: Sequence[str], runs: Path, budget: str) -> list[DenoiserSpec]:
    """The named denoisers, or all that can run and are trained, in each precision that they compute in.

    Raises BadInput for an unknown name and one that cannot run or is not trained.
    """
    obstacles = (cannot_run, partial(untrained, runs, budget))
    return [
        DenoiserSpec(name, precision=precision, weights=weights_file(name, runs, budget))
        for name in choose(names, map(DenoiserName, DENOISERS), *obstacles)
        for precision in precisions_of(name)
    ]


def trained_epochs(spec: DenoiserSpec) -> int | None:
    """The epochs of the network's training; None where its weights do not record them or there are none."""
    if spec.weights is None:
        return None
    recipe = read_metadata(spec.weights).get("recipe", {})
    return int(recipe["epochs"]) if "epochs" in recipe else None
