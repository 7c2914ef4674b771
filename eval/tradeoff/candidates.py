"""What can be traded: every denoiser, in each precision and size of network that there are weights for."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import safe_open

from errors import BadInput
from eval.bench.denoisers import PRECISIONS, Variant, variants
from eval.report.trade_plot import median_ms
from eval.sizes import SIZES, WHOLE, timed_as, trained_as
from files import read_json
from models.denoiser import Denoiser
from models.registry import without_taa
from models.taa import unwrapped
from models.weights import load_weights
from train.task import WEIGHTS_FILE, run_folder

Ready = dict[str, tuple[Denoiser, str | None]]  # by label: denoisers ready to use, and the files of their weights


@dataclass(frozen=True)
class Candidate:
    """A denoiser in one precision and, if it is trained, with its weights."""

    variant: Variant
    weights: Path | None

    @property
    def label(self) -> str:
        """Names the folder of its results: rae, rae-bfloat16."""
        return self.variant.label + ("" if self.variant.dtype == "float32" else f"-{self.variant.dtype}")

    def facts(self) -> dict[str, Any]:
        """In the form of trade.json."""
        return {"label": self.label, "denoiser": self.variant.label, "dtype": self.variant.dtype}

    def denoiser(self) -> Denoiser:
        """Raises BadInput where the weights are damaged or of another network."""
        name, denoiser = self.variant.name, self.variant.build()
        if self.weights:
            load_weights(unwrapped(denoiser), trained_as(name) if name in SIZES else without_taa(name), self.weights)
        denoiser.prepare(PRECISIONS[self.variant.dtype])
        return denoiser

    def epochs(self) -> int | None:
        """How long the network was trained; None where nobody says or nothing is trained."""
        if self.weights is None:
            return None
        with safe_open(self.weights, framework="pt") as file:
            epochs = json.loads((file.metadata() or {}).get("recipe", "{}")).get("epochs")
        return None if epochs is None else int(epochs)


def weights_of(name: str, runs: Path, profile: str) -> tuple[Path, str]:
    """Where a network's weights belong, and the command that trains them."""
    if name in SIZES:
        folder = runs / "ablation" / "wskp-windows" / f"{trained_as(name)}-0"
        return folder / WEIGHTS_FILE, f"onespp ablate wskp-windows --profile {profile} --runs {runs}"
    name = without_taa(name)
    return run_folder(runs, name, profile) / WEIGHTS_FILE, f"onespp train {name} --profile {profile} --runs {runs}"


def entrants(names: Sequence[str]) -> list[Variant]:
    """The named denoisers, or all, in each precision. Raises BadInput for an unknown name."""
    everyone = variants(names) if names else [*variants(()), *(v for v in variants([WHOLE]) if v.name == WHOLE)]
    return [  # others show the same a second time, or were not asked for
        v for v in everyone if v.compiled and not v.indirect and (v.name in names or not names)
    ]


def candidates(names: Sequence[str], runs: Path, profile: str) -> list[Candidate]:
    """The named denoisers, or all that can run and are trained.

    Raises BadInput for an unknown name and one without weights.
    """
    found: list[Candidate] = []
    missing: dict[str, str] = {}
    ablation = runs / "ablation" / "wskp-windows" / "results.json"
    other = read_json(ablation, ("profile",))["profile"] if ablation.exists() else None
    for variant in entrants(names):
        if not variant.build().parameter_count():
            found.append(Candidate(variant, None))
            continue
        path, command = weights_of(variant.name, runs, profile)
        if variant.name in SIZES and other != profile:
            why = (
                f"{ablation} is of the profile {other}: name another --runs" if other else f"`{command}` has not ended"
            )
            missing[variant.name] = f"{variant.name} has no weights of the profile {profile}, {why}"
        elif path.exists():
            found.append(Candidate(variant, path))
        else:
            missing[variant.name] = f"{variant.name} has no weights at {path}: train them with `{command}`"
    if names and missing:
        raise BadInput(next(iter(missing.values())))
    print(*(f"skipped: {text}" for text in missing.values()), sep="\n", end="\n" if missing else "")
    return found


def ready(chosen: Sequence[Candidate]) -> Ready:
    return {c.label: (c.denoiser(), str(c.weights) if c.weights else None) for c in chosen}


class Times:
    """Milliseconds of a frame of `size` (height, width), from what `onespp bench denoisers` left.

    `threads` are by default those at the top of the file, `device` is "cpu" or "cuda".
    Raises BadInput where nothing was measured like that.
    """

    def __init__(self, runs: Path, size: tuple[int, int], threads: int | None = None, device: str = "cpu"):
        path, self.size = runs / "bench" / ("results.json" if device == "cpu" else f"results-{device}.json"), size
        self.name = f"{size[1]}x{size[0]}"
        self.command = f"onespp bench denoisers --size {self.name} --runs {runs}"
        if not path.exists():
            raise BadInput(f"there are no times at {path}: measure them with `{self.command}`")
        bench = read_json(path, ("device", "threads", "rows"))
        self.device, self.threads = bench["device"], threads or bench["threads"]
        self.ms = median_ms(bench, size, self.threads)
        if not self.ms:
            asked, command = f"{self.name} with {self.threads} threads", f"{self.command} --threads {self.threads}"
            raise BadInput(f"{path} has no times of {asked}: measure them with `{command}`")

    def of(self, candidate: Candidate, signal: str) -> float | None:
        return self.ms.get((timed_as(candidate.variant.label, signal), candidate.variant.dtype))
