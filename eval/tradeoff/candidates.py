"""What can be traded: every denoiser, in each precision and size of network that there are weights for."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from eval.selection import cannot_run, choose, untrained, weights_file
from files import read_json
from models.extra_denoisers import EXTRA, WINDOW_SETS
from models.registry import DENOISERS
from models.spec import DenoiserSpec, precisions_of
from models.weights import read_metadata


def candidates(names: Sequence[str], runs: Path, budget: str) -> list[DenoiserSpec]:
    """The named denoisers, or all that can run and are trained, in each precision that they compute in.

    Raises BadInput for an unknown name and one that cannot run or is not trained.
    """
    obstacles = (cannot_run, partial(of_another_budget, runs, budget), partial(untrained, runs, budget))
    return [
        DenoiserSpec(name, precision=precision, weights=weights_file(name, runs, budget))
        for name in choose(names, (*DENOISERS, *EXTRA), *obstacles)
        for precision in precisions_of(name)
    ]


def of_another_budget(runs: Path, budget: str, name: str) -> str | None:
    """Why the weights of a network are not to be compared: the ablation that trained them had another budget."""
    results = runs / "ablation" / "wskp-windows" / "results.json"
    if name not in WINDOW_SETS:
        return None
    if not results.exists():
        return f"`onespp ablate wskp-windows --budget {budget} --runs {runs}` has not ended"
    other = read_json(results, ("profile",))["profile"]
    return None if other == budget else f"{results} is of the budget {other}: name another --runs"


def trained_epochs(spec: DenoiserSpec) -> int | None:
    """How long the network was trained; None where its weights do not say so or there are none."""
    if spec.weights is None:
        return None
    recipe = read_metadata(spec.weights).get("recipe", {})
    return int(recipe["epochs"]) if "epochs" in recipe else None
