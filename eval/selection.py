"""Who can run, and why not: the one way in which commands choose denoisers."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from errors import BadInput
from models.names import DenoiserName
from models.registry import DENOISERS, parse_name, prototype
from models.shipped_weights import shipped_weights
from models.spec import DenoiserSpec, fastest_precision
from train.recipes import TRAINABLE
from train.task import WEIGHTS_FILE, run_folder

USUAL_BUDGET = "quick"  # of commands that do not ask for one

Obstacle = Callable[[DenoiserName], str | None]  # why a denoiser cannot run, and the remedy


def choose(names: Sequence[str], everyone: Iterable[DenoiserName], *obstacles: Obstacle) -> list[DenoiserName]:
    """The named denoisers, or all of `everyone` in whose way nothing stands; prints which are skipped, and why.

    Raises BadInput where a named one is unknown or cannot run.
    """
    chosen: list[DenoiserName] = []
    obstacles = obstacles if names else (*obstacles, takes_long)
    skipped: dict[str, list[DenoiserName]] = {}  # by the reason that they have in common
    for name in dict.fromkeys(map(parse_name, names) if names else everyone):
        reason = next(filter(None, (obstacle(name) for obstacle in obstacles)), None)
        if reason and names:
            raise BadInput(f"{name}: {reason}")
        if reason:
            skipped.setdefault(reason.replace(name.base, "NAME"), []).append(name)
        else:
            chosen.append(name)
    for reason, alike in skipped.items():
        text = reason if len(alike) > 1 else reason.replace("NAME", str(alike[0]))
        print(f"{', '.join(map(str, alike))}: skipped, {text}")
    return chosen


def takes_long(name: DenoiserName) -> str | None:
    """Why a denoiser runs only where it is named."""
    return "it takes seconds a frame: name it to run it" if prototype(name).offline else None


def cannot_run(name: DenoiserName) -> str | None:
    """Why a denoiser cannot run on this machine."""
    return prototype(name).unavailable()


def weights_file(name: DenoiserName, runs: Path, budget: str) -> Path | None:
    """Where the weights of a network are, or belong; None for a denoiser without.

    Those of NAME@BUDGET are in RUNS; those of a name alone are shipped, or else in RUNS those of `budget`.
    """
    if not prototype(name).is_network:
        return None
    shipped = None if name.budget else shipped_weights(name.base)
    return shipped or run_folder(runs, name.base, name.budget or budget) / WEIGHTS_FILE


def untrained(runs: Path, budget: str, name: DenoiserName) -> str | None:
    """Why a network has no weights yet, and the command that trains them."""
    path = weights_file(name, runs, budget)
    if path is None or path.exists():
        return None
    command = f"onespp train {name.base} --budget {name.budget or budget} --runs {runs}"
    return f"it has no weights at {path}" + (f": train them with `{command}`" if name.base in TRAINABLE else "")


def weights_of(name: DenoiserName, runs: Path) -> Path | None:
    """The weights of a denoiser that is named; None for one without. Raises BadInput where it has none yet."""
    reason = untrained(runs, USUAL_BUDGET, name)
    if reason:
        raise BadInput(f"{name}: {reason}")
    return weights_file(name, runs, USUAL_BUDGET)


def everyone(runs: Path, budget: str) -> Iterator[DenoiserName]:
    """All denoisers, beside shipped weights those that RUNS holds; last those that are evaluated with wrappers."""
    plain = [DenoiserName(base) for base in DENOISERS]
    wrapped = [name.wrapped(wrapper) for name in plain for wrapper in prototype(name).evaluated_with]
    for name in (*plain, *wrapped):
        yield name
        trained = name.with_budget(budget)
        if shipped_weights(name.base) and not untrained(runs, budget, trained):
            yield trained


def evaluated(names: Sequence[str], runs: Path, budget: str, device: str = "cpu") -> list[DenoiserSpec]:
    """The named denoisers, or everyone who can run and is trained, as `onespp eval` runs them.

    Raises BadInput where a named one is unknown, cannot run or is not trained.
    """
    chosen = choose(names, everyone(runs, budget), cannot_run, partial(untrained, runs, budget))
    return [
        DenoiserSpec(name, None, fastest_precision(name, device), weights_file(name, runs, budget), device=device)
        for name in chosen
    ]


def with_indirect_baselines(specs: Sequence[DenoiserSpec]) -> list[DenoiserSpec]:
    """The specs, and beside one that returns indirect light alone the baselines among them on that, too."""
    if all(spec.returns == "total" for spec in specs):
        return [*specs]
    return [*specs, *(replace(spec, signal="indirect") for spec in specs if spec.facts.is_baseline)]
