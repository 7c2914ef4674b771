"""`onespp papers`: measured values beside those that the papers print for their own scenes, and whose order holds."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from tabulate import tabulate

from eval.ablation.summary import Run, over_seeds
from eval.means import joint_floor
from eval.metrics import METRICS, Quantity, within_floor
from eval.papers.tables import TABLES, PaperTable
from eval.report.table_rows import mean_of, of, one_spp
from eval.results import read_results
from eval.text_table import LEGEND, NEAR
from files import read_json
from train.recipes import TRAINABLE

TITLES = {metric: METRICS[metric] for metric in ("rmse", "psnr", "ssim", "l1", "mse")} | {
    "ms": Quantity("ms", "{:.4g}"),
    "prediction": Quantity("prediction ms", "{:.4g}"),
    "reconstruction": Quantity("reconstruction ms", "{:.4g}"),
}
SIZE = (720, 1280)  # of WSKP's Table 3
HEADER = """\
The papers' values are of their own scenes and machines, mean over scenes; ours are means over the test clips here.
Only orders can be compared. Plots are lost in the texts of the papers, so what is only drawn there is not here."""

Value = Callable[[str, str], float | None]  # of a denoiser and a metric


@dataclass
class Measured:
    """What one command left, and the command."""

    value: Value
    command: str
    floor: Value = lambda denoiser, metric: None  # noise floor

    def near(self, denoiser: str, metric: str) -> bool:
        """Whether the value says no more than that the image is as close to the truth as the reference."""
        return within_floor(metric, self.value(denoiser, metric), self.floor(denoiser, metric))


def from_evaluation(runs: Path, profile: str, signal: str) -> Measured:
    """Means over the clips of 1 spp of RUNS/eval/results.json where a metric is defined."""
    path = runs / "eval" / "results.json"
    clips = one_spp(read_results(runs)[1]) if path.exists() else []
    ours = [clip for clip in clips if clip.signal == signal]
    floors = [clip.reference.metrics for clip in ours]

    def value(denoiser: str, metric: str) -> float | None:
        return mean_of(ours, denoiser)[metric] if of(ours, denoiser) else None

    def floor(denoiser: str, metric: str) -> float | None:
        return joint_floor([r.metrics for r in of(ours, denoiser)], floors).get(metric) if of(ours, denoiser) else None

    return Measured(value, f"onespp eval --profile {profile} --runs {runs}", floor)


def from_bench(runs: Path) -> Measured:
    """Medians of RUNS/bench/results.json at the paper's size, each denoiser's in its fastest precision."""
    path = runs / "bench" / "results.json"
    rows = read_json(path, ("rows",))["rows"] if path.exists() else []

    def value(denoiser: str, metric: str) -> float | None:
        ours = [r for r in rows if (r["denoiser"], r["height"], r["width"]) == (denoiser, *SIZE)]
        fastest = min(ours, key=lambda row: row["ms_median"], default=None)
        if fastest is None or metric == "ms":
            return fastest and fastest["ms_median"]
        share = fastest.get("prediction")
        return share and fastest["ms_median"] * (share if metric == "prediction" else 1 - share)

    return Measured(value, f"onespp bench denoisers --size {SIZE[1]}x{SIZE[0]} --runs {runs}")


def from_ablation(runs: Path, profile: str) -> Measured:
    """Means over clips and seeds of RUNS/ablation/wskp-repvgg/results.json."""
    path = runs / "ablation" / "wskp-repvgg" / "results.json"
    rows = [Run(**row) for row in read_json(path, ("rows",))["rows"]] if path.exists() else []

    def value(variant: str, metric: str) -> float | None:
        found = over_seeds(rows, variant, metric)
        return found[0] if found else None

    return Measured(value, f"onespp ablate wskp-repvgg --profile {profile} --runs {runs}")


def measured(table: PaperTable, runs: Path, profile: str = "quick") -> Measured:
    """Raises BadInput where the file is damaged."""
    if table.where == "bench":
        return from_bench(runs)
    return from_ablation(runs, profile) if table.where == "ablation" else from_evaluation(runs, profile, table.signal)


def compared(table: PaperTable) -> list[str]:
    """The metrics that ours can be compared by."""
    return [metric for metric in table.metrics if metric not in table.incomparable]


def is_better(metric: str, a: float, b: float) -> bool:
    return a > b if TITLES[metric].more_is_better else a < b


class Order(NamedTuple):
    """A pair of methods that a paper orders by a metric, in the mean and in `scenes` of all its scenes."""

    metric: str
    better: str
    worse: str
    scenes: int


def orders(table: PaperTable) -> list[Order]:
    """The order of every two methods that are here too, by every metric that can be compared."""
    found = []
    for metric in compared(table):
        for a, b in combinations([method for method in table.ours if metric in table.values[method]], 2):
            better, worse = (a, b) if is_better(metric, table.mean(a, metric), table.mean(b, metric)) else (b, a)
            pairs = zip(table.values[better][metric], table.values[worse][metric], strict=True)
            scenes = sum(is_better(metric, x, y) for x, y in pairs)
            if 2 * scenes > len(table.scenes):  # else the paper has them on a par
                found.append(Order(metric, better, worse, scenes))
    return found


def verdict(table: PaperTable, order: Order, here: Measured) -> str:
    """Whether an order holds here, with the numbers."""
    names = [table.ours[method] for method in (order.better, order.worse)]
    ours = [here.value(name, order.metric) for name in names]
    better, worse = ours
    title, form = TITLES[order.metric].title, TITLES[order.metric].form
    text = f"{title}: {names[0]} before {names[1]} (there in {order.scenes} of {len(table.scenes)})"
    if better is None or worse is None:
        return f"{text}: not measured"
    numbers = f"{form.format(better)} against {form.format(worse)}"
    if all(here.near(name, order.metric) for name in names):
        return f"{text}: both within the noise floor, {numbers}"
    return f"{text}: {'holds' if is_better(order.metric, better, worse) else 'DOES NOT HOLD'}, {numbers}"


def line(table: PaperTable, method: str, here: Measured) -> dict[str, str]:
    """A method, and of each metric the paper's mean and, where they can be compared, ours."""
    name = table.ours.get(method)
    cells = {"there": method, "here": name or "-"}
    for metric in table.metrics:
        title, form = TITLES[metric].title, TITLES[metric].form
        theirs = table.mean(method, metric) if metric in table.values[method] else None
        cells[f"{title}, paper"] = "-" if theirs is None else form.format(theirs)
        if metric in compared(table):
            ours = here.value(name, metric) if name else None
            mark = NEAR if name and here.near(name, metric) else ""
            cells[f"{title}, ours"] = "-" if ours is None else mark + form.format(ours)
    return cells


def section(table: PaperTable, runs: Path, profile: str) -> str:
    """One table of a paper: methods, means there and here, notes, orders."""
    here = measured(table, runs, profile)
    lines = [line(table, method, here) for method in table.values]
    parts = [table.source, f"scenes: {', '.join(table.scenes)}", tabulate(lines, "keys", disable_numparse=True)]
    parts += [f"  * {note}" for note in table.notes]
    parts += [f"  - {verdict(table, order, here)}" for order in orders(table)]
    if absent := missing(table, here.value):
        untrained = [name for name in absent if name in TRAINABLE and table.where == "eval"]
        first = f"`onespp train {' '.join(untrained)} --profile {profile} --runs {runs}` and " if untrained else ""
        parts.append(f"  not measured: {', '.join(absent)}; get them with {first}`{here.command}`")
    return "\n".join(parts)


def missing(table: PaperTable, value: Value) -> list[str]:
    """Denoisers here without any number of the table."""
    return [name for name in table.ours.values() if all(value(name, metric) is None for metric in compared(table))]


def against_papers(runs: Path, profile: str = "quick") -> str:
    """All tables, as text. What has not been measured is "-", with the command to measure it in the profile.

    Raises BadInput where a file of results is damaged.
    """
    return "\n\n".join([HEADER, *(section(table, runs, profile) for table in TABLES), LEGEND])
