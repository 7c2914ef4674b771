"""Which denoisers a command runs, which weights they take, and why others cannot run."""

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from datasets.channels import CHANNELS
from datasets.clip import Clip
from errors import BadInput
from models.registry import DENOISERS, DenoiserName, parse_name, prototype, shipped_weights
from models.spec import DenoiserSpec, fastest_precision
from train.recipes import TRAINABLE
from train.task import WEIGHTS_FILE, run_folder

USUAL_BUDGET = "quick"  # of commands that do not ask for one

Obstacle = Callable[[DenoiserName], str | None]  # why a denoiser cannot run, and the remedy


def choose(names: Sequence[str], default: Iterable[DenoiserName], *obstacles: Obstacle) -> list[DenoiserName]:
    """The named denoisers, or those of `default` without an obstacle; prints which are skipped and why.

    Raises BadInput where a named one is unknown or cannot run.
    """
    chosen: list[DenoiserName] = []
    skipped: dict[str, list[DenoiserName]] = {}  # by the reason that they have in common
    for name in dict.fromkeys(map(parse_name, names) if names else default):
        reason = next(filter(None, (obstacle(name) for obstacle in obstacles)), None)
        if not (reason or names) and prototype(name).offline:
            reason = "it takes seconds a frame: name it to run it"
        if reason and names:
            raise BadInput(f"{name}: {reason}")
        if reason:
            # Names of packages and their extras contain those of denoisers, too.
            alike_for_others = re.sub(rf"(?<![\w\[]){re.escape(name.base)}(?!\w)", "NAME", reason)
            skipped.setdefault(alike_for_others, []).append(name)
        else:
            chosen.append(name)
    for reason, alike in skipped.items():
        text = reason if len(alike) > 1 else reason.replace("NAME", str(alike[0]))
        print(f"{', '.join(map(str, alike))}: skipped, {text}")
    return chosen


def cannot_run(name: DenoiserName) -> str | None:
    """Why a denoiser cannot run on this machine; None where it can."""
    return prototype(name).unavailable()


def weights_file(name: DenoiserName, runs: Path, budget: str) -> Path | None:
    """The path of a network's weights, whether they exist or not; None for a denoiser without weights.

    NAME@BUDGET has those in RUNS. NAME has the shipped ones, or where none are shipped those of `budget` in RUNS.
    """
    if not prototype(name).is_network:
        return None
    shipped = None if name.budget else shipped_weights(name.base)
    return shipped or run_folder(runs, name.base, name.budget or budget) / WEIGHTS_FILE


def untrained(runs: Path, budget: str, name: DenoiserName) -> str | None:
    """That a network has no weights, with the command that trains them; None where it has or needs none."""
    path = weights_file(name, runs, budget)
    if path is None or path.exists():
        return None
    command = f"onespp train {name.base} --budget {name.budget or budget} --runs {runs}"
    return f"it has no weights at {path}" + (f": train them with `{command}`" if name.base in TRAINABLE else "")


def lacks_channels(clips: Iterable[Clip], name: DenoiserName) -> str | None:
    """That a clip lacks channels which a denoiser reads; None where it has all. Sample buffers are optional."""
    reads = [channel for channel in prototype(name).reads if CHANNELS[channel].kind != "buffers"]
    for clip in clips:
        if clip.is_imported and prototype(name).signal == "indirect":
            return f"{clip.path} was imported and has no indirect light"
        if missing := [channel for channel in reads if channel not in clip.channels]:
            return f"{clip.path} has no {' and no '.join(missing)}: take clips that `onespp dataset` rendered"
    return None


def weights_of(name: DenoiserName, runs: Path) -> Path | None:
    """The file of a denoiser's weights; None for one without weights. Raises BadInput where they are missing."""
    if reason := untrained(runs, USUAL_BUDGET, name):
        raise BadInput(f"{name}: {reason}")
    return weights_file(name, runs, USUAL_BUDGET)


def with_suffixes(base: str) -> list[str]:
    """The names under which a denoiser is evaluated with wrappers."""
    return [f"{base}+{suffix}" for suffix in prototype(base).evaluated_with]


def evaluated_by_default(runs: Path, budget: str) -> Iterator[DenoiserName]:
    """All denoisers, then those with wrappers; networks with shipped weights and with those trained in `budget`."""
    plain = [DenoiserName(base) for base in DENOISERS]
    wrapped = [parse_name(each) for base in DENOISERS for each in with_suffixes(base)]
    for name in (*plain, *wrapped):
        yield name
        trained = replace(name, budget=budget)
        if shipped_weights(name.base) and not untrained(runs, budget, trained):
            yield trained


def evaluated(
    names: Sequence[str], runs: Path, budget: str, device: str = "cpu", clips: Sequence[Clip] = ()
) -> list[DenoiserSpec]:
    """The named denoisers, or all that can run on the clips and have weights, as `onespp eval` runs them.

    Raises BadInput where a named one is unknown, cannot run or is not trained.
    """
    obstacles = (cannot_run, partial(untrained, runs, budget), partial(lacks_channels, clips))
    chosen = choose(names, evaluated_by_default(runs, budget), *obstacles)
    return [
        DenoiserSpec(name, None, fastest_precision(name, device), weights_file(name, runs, budget), device=device)
        for name in chosen
    ]


def baselines() -> tuple[str, ...]:
    """The names of the denoisers with which those of total light are compared, and what is evaluated after them."""
    plain = [name for name in DENOISERS if "total" in prototype(name).baseline_for]
    return tuple(each for name in plain for each in (name, *with_suffixes(name)))


def with_indirect_baselines(specs: Sequence[DenoiserSpec]) -> list[DenoiserSpec]:
    """The specs; if any returns indirect light alone, its baselines among them also with that signal."""
    if all(spec.returns == "total" for spec in specs):
        return [*specs]
    return [*specs, *(replace(spec, signal="indirect") for spec in specs if "indirect" in spec.facts.baseline_for)]
