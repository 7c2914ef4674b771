"""`onespp papers`: what the papers print for their own scenes beside what is measured here, and whose order holds."""

from itertools import combinations
from pathlib import Path
from typing import NamedTuple

from tabulate import tabulate

from eval.metrics import METRICS, Quantity
from eval.papers.measurements import Measurements, measurements
from eval.papers.tables import TABLES, PaperTable
from eval.text_table import LEGEND, NEAR
from models.shipped_weights import shipped_weights
from train.recipes import TRAINABLE

PAPER_QUANTITIES = {metric: METRICS[metric] for metric in ("rmse", "psnr", "ssim", "l1", "mse")} | {
    "ms": Quantity("ms", "{:.4g}"),
    "prediction": Quantity("prediction ms", "{:.4g}"),
    "reconstruction": Quantity("reconstruction ms", "{:.4g}"),
}
HEADER = """\
The papers' values are of their own scenes and machines, mean over scenes; ours are means over the test clips here.
Only orders can be compared. Plots are lost in the texts of the papers, so what is only drawn there is not here."""


def is_better(metric: str, a: float, b: float) -> bool:
    """Whether `a` is better than `b`."""
    return a > b if PAPER_QUANTITIES[metric].more_is_better else a < b


class Order(NamedTuple):
    """A pair of methods that a paper orders by a metric, in the mean and in `scenes` of all its scenes."""

    metric: str
    better: str
    worse: str
    scenes: int


def orders(table: PaperTable) -> list[Order]:
    """The order of every two methods that are here too, by every metric that can be compared."""
    found = []
    for metric in table.comparable:
        for a, b in combinations([method for method in table.ours if metric in table.values[method]], 2):
            better, worse = (a, b) if is_better(metric, table.mean(a, metric), table.mean(b, metric)) else (b, a)
            pairs = zip(table.values[better][metric], table.values[worse][metric], strict=True)
            scenes = sum(is_better(metric, x, y) for x, y in pairs)
            if 2 * scenes > len(table.scenes):  # else the paper has them on a par
                found.append(Order(metric, better, worse, scenes))
    return found


def order_verdict(table: PaperTable, order: Order, here: Measurements) -> str:
    """Whether an order holds here, with the numbers."""
    names = [table.ours[method] for method in (order.better, order.worse)]
    better, worse = (here.value(name, order.metric) for name in names)
    quantity = PAPER_QUANTITIES[order.metric]
    text = f"{quantity.title}: {names[0]} before {names[1]} (there in {order.scenes} of {len(table.scenes)})"
    if better is None or worse is None:
        return f"{text}: not measured"
    numbers = f"{quantity.form.format(better)} against {quantity.form.format(worse)}"
    if all(here.near(name, order.metric) for name in names):
        return f"{text}: both within the noise floor, {numbers}"
    return f"{text}: {'holds' if is_better(order.metric, better, worse) else 'DOES NOT HOLD'}, {numbers}"


def method_row(table: PaperTable, method: str, here: Measurements) -> dict[str, str]:
    """A method, and of each metric the paper's mean and, where they can be compared, ours."""
    name = table.ours.get(method)
    cells = {"there": method, "here": name or "-"}
    for metric in table.metrics:
        title = PAPER_QUANTITIES[metric].title
        form = PAPER_QUANTITIES[metric].form
        theirs = table.mean(method, metric) if metric in table.values[method] else None
        cells[f"{title}, paper"] = "-" if theirs is None else form.format(theirs)
        if metric in table.comparable:
            ours = here.value(name, metric) if name else None
            mark = NEAR if name and here.near(name, metric) else ""
            cells[f"{title}, ours"] = "-" if ours is None else mark + form.format(ours)
    return cells


def unmeasured(table: PaperTable, here: Measurements) -> list[str]:
    """Denoisers here without any number of the table."""
    return [
        name for name in table.ours.values() if all(here.value(name, metric) is None for metric in table.comparable)
    ]


def table_text(table: PaperTable, runs: Path, budget: str) -> str:
    """One table of a paper: methods, means there and here, notes, orders."""
    here = measurements(table, runs, budget)
    lines = [method_row(table, method, here) for method in table.values]
    parts = [table.source, f"scenes: {', '.join(table.scenes)}", tabulate(lines, "keys", disable_numparse=True)]
    parts += [f"  * {note}" for note in table.notes]
    parts += [f"  - {order_verdict(table, order, here)}" for order in orders(table)]
    if absent := unmeasured(table, here):
        trainable = [name for name in absent if name in TRAINABLE and table.where == "eval"]
        untrained = [name for name in trainable if not shipped_weights(name)]
        first = f"`onespp train {' '.join(untrained)} --budget {budget} --runs {runs}` and " if untrained else ""
        parts.append(f"  not measured: {', '.join(absent)}; get them with {first}`{here.command}`")
    return "\n".join(parts)


def against_papers(runs: Path, budget: str = "quick") -> str:
    """All tables, as text. What has not been measured is "-", with the command to measure it in the budget.

    Raises BadInput where a file of results is damaged.
    """
    return "\n\n".join([HEADER, *(table_text(table, runs, budget) for table in TABLES), LEGEND])
