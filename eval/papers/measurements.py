"""What was measured here, in the terms of a paper's table, read from the files that other commands left."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from datasets.frame import Signal
from eval.ablation.variant_run import VariantRun, over_seeds
from eval.bench.denoisers import results_file
from eval.bench.sizes import size_name
from eval.means import scores_of
from eval.metrics import within_floor
from eval.papers.tables import PaperTable
from eval.results import of_one_spp, read_results, results_of
from files import read_json

TABLE_3_SIZE = (720, 1280)  # height and width of the frames that WSKP's Table 3 times

Value = Callable[[str, str], float | None]  # of a denoiser and a metric


@dataclass(frozen=True)
class Measurements:
    """What one command left.

    Attributes:
        value: None where a denoiser was not measured by a metric.
        command: what measures.
        floor: the noise floor of a value; None where there is none.
    """

    value: Value
    command: str
    floor: Value = lambda denoiser, metric: None

    def near(self, denoiser: str, metric: str) -> bool:
        """Whether the value says no more than that the image is as close to the truth as the reference."""
        return within_floor(metric, self.value(denoiser, metric), self.floor(denoiser, metric))


def from_evaluation(runs: Path, budget: str, signal: Signal) -> Measurements:
    """Means over the clips of 1 spp of RUNS/eval/results.json where a metric is defined."""
    path = runs / "eval" / "results.json"
    clips = of_one_spp(read_results(runs)[1]) if path.exists() else []
    ours = [clip for clip in clips if clip.signal == signal]

    def value(denoiser: str, metric: str) -> float | None:
        return scores_of(ours, denoiser).means[metric] if results_of(ours, denoiser) else None

    def floor(denoiser: str, metric: str) -> float | None:
        return scores_of(ours, denoiser).joint_floor.get(metric) if results_of(ours, denoiser) else None

    return Measurements(value, f"onespp eval --budget {budget} --runs {runs}", floor)


def from_bench(runs: Path) -> Measurements:
    """Medians of RUNS/bench/results.json at the paper's size, each denoiser's in its fastest precision."""
    path = results_file(runs)
    rows = read_json(path, ("rows",))["rows"] if path.exists() else []

    def value(denoiser: str, metric: str) -> float | None:
        ours = [row for row in rows if (row["denoiser"], row["height"], row["width"]) == (denoiser, *TABLE_3_SIZE)]
        if not ours:
            return None
        fastest = min(ours, key=lambda row: row["ms_median"])
        ms: float = fastest["ms_median"]
        if metric == "ms":
            return ms
        share = fastest.get("prediction")
        if not share:
            return None
        return ms * (share if metric == "prediction" else 1 - share)

    return Measurements(value, f"onespp bench denoisers --size {size_name(TABLE_3_SIZE)} --runs {runs}")


def from_ablation(runs: Path, budget: str) -> Measurements:
    """Means over clips and seeds of RUNS/ablation/wskp-repvgg/results.json."""
    path = runs / "ablation" / "wskp-repvgg" / "results.json"
    rows = [VariantRun(**row) for row in read_json(path, ("rows",))["rows"]] if path.exists() else []

    def value(variant: str, metric: str) -> float | None:
        found = over_seeds(rows, variant, metric)
        return found.mean if found else None

    return Measurements(value, f"onespp ablate wskp-repvgg --budget {budget} --runs {runs}")


def measurements(table: PaperTable, runs: Path, budget: str = "quick") -> Measurements:
    """What is to be compared with a table. Raises BadInput where the file is damaged."""
    if table.where == "bench":
        return from_bench(runs)
    if table.where == "ablation":
        return from_ablation(runs, budget)
    return from_evaluation(runs, budget, table.signal)
