"""Who can run, and why not: the one way in which commands choose denoisers."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from errors import BadInput
from models.extra_denoisers import WINDOW_SETS, windows_label
from models.registry import ADAPTIVE, DENOISERS, plain_name
from models.shipped_weights import shipped_weights
from models.spec import DenoiserSpec, class_of, precision_in_use, split_name, with_budget
from train.recipes import TRAINABLE
from train.task import WEIGHTS_FILE, run_folder

# What denoisers of indirect light are compared with, on that alone.
BASELINES = ("noisy", "accumulated", "svgf", "trmv")

USUAL_BUDGET = "quick"  # of commands that do not ask for one

WORTH_ADAPTING = ("oidn-accumulated", "wskp6")  # these are judged with adaptive accumulation as well

Obstacle = Callable[[str], str | None]  # why the denoiser of a name cannot run, and the remedy


def choose(names: Sequence[str], everyone: Iterable[str], *obstacles: Obstacle) -> list[str]:
    """The named denoisers, or all of `everyone` in whose way nothing stands; says who is left out, and why.

    Raises BadInput where a named one is unknown or cannot run.
    """
    chosen: list[str] = []
    obstacles = obstacles if names else (*obstacles, takes_long)
    skipped: dict[str, list[str]] = {}  # names by what is in the way of all of them alike
    for name in dict.fromkeys(names or everyone):
        reason = next(filter(None, (obstacle(name) for obstacle in obstacles)), None)
        if reason and names:
            raise BadInput(f"{name}: {reason}")
        if reason:
            skipped.setdefault(reason.replace(plain_name(name), "NAME"), []).append(name)
        else:
            chosen.append(name)
    for reason, alike in skipped.items():
        print(f"{', '.join(alike)}: skipped, {reason if len(alike) > 1 else reason.replace('NAME', alike[0])}")
    return chosen


def takes_long(name: str) -> str | None:
    """Why a denoiser runs only where it is named. Raises BadInput for an unknown name."""
    return "it takes seconds a frame: name it to run it" if class_of(name).offline else None


def cannot_run(name: str) -> str | None:
    """Why a denoiser cannot run on this machine. Raises BadInput for an unknown name."""
    return class_of(name).unavailable()


def weights_file(name: str, runs: Path, budget: str) -> Path | None:
    """Where the weights of a network are, or belong; None for a denoiser without.

    Those of NAME@BUDGET are in RUNS; those of a name alone are shipped, or else in RUNS those of `budget`.
    """
    if not class_of(name).is_network:
        return None
    if name in WINDOW_SETS:
        return runs / "ablation" / "wskp-windows" / f"{windows_label(WINDOW_SETS[name])}-0" / WEIGHTS_FILE
    denoiser, named = split_name(name)
    shipped = None if named else shipped_weights(denoiser)
    return shipped or run_folder(runs, plain_name(denoiser), named or budget) / WEIGHTS_FILE


def untrained(runs: Path, budget: str, name: str) -> str | None:
    """Why a network has no weights yet, and the command that trains them."""
    path = weights_file(name, runs, budget)
    if path is None or path.exists():
        return None
    denoiser, named = split_name(name)
    network = plain_name(denoiser)
    training = "ablate wskp-windows" if name in WINDOW_SETS else f"train {network}"
    trainable = name in WINDOW_SETS or network in TRAINABLE
    remedy = f": train them with `onespp {training} --budget {named or budget} --runs {runs}`" if trainable else ""
    return f"it has no weights at {path}{remedy}"


def weights_of(name: str, runs: Path) -> Path | None:
    """The weights of a denoiser that is named; None for one without. Raises BadInput where it has none yet."""
    choose([name], (), partial(untrained, runs, USUAL_BUDGET))
    return weights_file(name, runs, USUAL_BUDGET)


def everyone(runs: Path, budget: str) -> Iterator[str]:
    """All denoisers, some with adaptive accumulation as well; beside shipped weights those that RUNS holds."""
    for name in (*DENOISERS, *(name + ADAPTIVE for name in WORTH_ADAPTING if name in DENOISERS)):
        yield name
        trained = with_budget(name, budget)
        if shipped_weights(name) and not untrained(runs, budget, trained):
            yield trained


def evaluated(names: Sequence[str], runs: Path, budget: str) -> list[DenoiserSpec]:
    """The named denoisers, or everyone who can run and is trained, as `onespp eval` runs them.

    Raises BadInput where a named one is unknown, cannot run or is not trained.
    """
    chosen = choose(names, everyone(runs, budget), cannot_run, partial(untrained, runs, budget))
    return [
        DenoiserSpec(name, precision=precision_in_use(name), weights=weights_file(name, runs, budget))
        for name in chosen
    ]


def with_indirect_baselines(specs: Sequence[DenoiserSpec]) -> list[DenoiserSpec]:
    """The specs, and beside one that returns indirect light alone the baselines among them on that, too."""
    if all(spec.returns == "total" for spec in specs):
        return [*specs]
    return [*specs, *(replace(spec, signal="indirect") for name in BASELINES for spec in specs if spec.name == name)]
