"""What came out of an ablation, in words: the table, and which of the paper's findings hold."""

from collections.abc import Sequence
from dataclasses import dataclass

from tabulate import tabulate

from eval.ablation.definitions import Ablation, Finding, Pair
from eval.ablation.variant_run import ABLATION_QUANTITIES, VariantRun, over_seeds


@dataclass(frozen=True)
class JudgedFinding(Finding):
    """A paper's finding, and whether it holds `here`."""

    here: str


def seed_mean_text(runs: Sequence[VariantRun], label: str, metric: str) -> str:
    """A variant's mean over seeds ± their standard deviation."""
    found = over_seeds(runs, label, metric)
    form = ABLATION_QUANTITIES[metric].form
    if found is None:
        return "-"
    return form.format(found.mean) + (f" ± {form.format(found.spread)}" if found.spread is not None else "")


def holds(finding: Finding, pair: Pair, runs: Sequence[VariantRun]) -> bool:
    """Whether the first of a pair is better than the second, in the mean of `runs`."""
    sign = 1 if ABLATION_QUANTITIES[finding.metric].more_is_better else -1
    better, worse = (over_seeds(runs, label, finding.metric) for label in pair)
    return better is not None and worse is not None and sign * better.mean > sign * worse.mean


def finding_verdict(finding: Finding, runs: Sequence[VariantRun]) -> str:
    """Whether the paper's order holds in the means over seeds, where it does not, and in how many seeds it does."""
    if any(over_seeds(runs, label, finding.metric) is None for pair in finding.pairs for label in pair):
        return "not defined on these clips"
    against = [pair for pair in finding.pairs if not holds(finding, pair, runs)]
    text = f"does not hold in {len(against)} of {len(finding.pairs)}: " if against else "holds"
    values = [[f"{label} {seed_mean_text(runs, label, finding.metric)}" for label in pair] for pair in against]
    text += "; ".join(" is no better than ".join(pair) for pair in values)
    by_seed = [[run for run in runs if run.seed == seed] for seed in sorted({run.seed for run in runs})]
    if len(by_seed) > 1:
        agree = sum(all(holds(finding, pair, alone) for pair in finding.pairs) for alone in by_seed)
        text += f" (seed by seed: in {agree} of {len(by_seed)})"
    return text


def judged_findings(ablation: Ablation, runs: Sequence[VariantRun]) -> list[JudgedFinding]:
    return [JudgedFinding(**vars(finding), here=finding_verdict(finding, runs)) for finding in ablation.findings]


def ablation_table(ablation: Ablation, runs: Sequence[VariantRun], form: str = "simple") -> str:
    """A row a variant beside the paper's number, and below them the findings. `form` is one of tabulate's."""
    sizes = {run.variant: run.parameters for run in runs}
    lines = []
    for variant in ablation.variants:
        values = [seed_mean_text(runs, variant.label, metric) for metric in ablation.metrics]
        lines.append([variant.label, f"{sizes[variant.label]:,}", *values, variant.paper])
    titles = {metric: quantity.title for metric, quantity in ABLATION_QUANTITIES.items()}
    head = ["variant", "parameters", *(titles[metric] for metric in ablation.metrics), "paper, its scenes"]
    table = tabulate(lines, head, form, disable_numparse=True)
    found = [f"- {f.text} (by {titles[f.metric]}): {f.here}" for f in judged_findings(ablation, runs)]
    return "\n".join([table, "\nWhat was to be found, and whether it was here:\n", *found])
