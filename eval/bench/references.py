"""`onespp bench references`: what a render budget is best spent on, many rooms with noisy references or few with clean.

Noise2Noise (Lehtinen et al. 2018, §3.2, the table of budgets) asked it of still images; here it is asked of temporal
denoisers at one sample a pixel.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from statistics import mean
from typing import NamedTuple

from matplotlib.figure import Figure
from tabulate import tabulate
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.generate import generate
from errors import BadInput
from eval.ablation.definitions import AblationVariant
from eval.ablation.run import clip_means, entrant_of
from eval.bench.output import bench_folder
from eval.harness import clips_of_one_spp
from eval.metrics import METRICS, Values
from files import read_json, write_file, write_json
from models.registry import create
from plotting import DPI, plt, save_figure
from provenance import device_in_words
from train.loop import train_network
from train.losses.network_loss import LossTerms
from train.losses.relative import RelativeTerms
from train.recipe import Recipe
from train.recipes import recipe_for
from train.task import Task


class Split(NamedTuple):
    """A way to spend the budget."""

    rooms: int
    spp: int  # of a reference

    @property
    def profile(self) -> str:
        return f"rooms-{self.rooms}x{self.spp}"


SPLITS = (Split(48, 4), Split(40, 16), Split(22, 64), Split(8, 256))  # these take about as long to render
BUDGET = "quick"  # whose recipes are followed, with these numbers of steps on all splits
STEPS = {"wskp6": 500, "ntd-mean": 300}
LOSSES: dict[str, LossTerms | None] = {"relative": RelativeTerms(), "paper": None}  # None: the recipe's
SHOWN = ("psnr", "ssim", "temporal_error")


@dataclass(frozen=True)
class BudgetRun:
    """One training on one split of the budget.

    Attributes:
        spp: of a reference.
        seconds: that the rooms took to render.
        clips: means of metrics on each test clip.
    """

    network: str
    loss: str
    rooms: int
    spp: int
    seed: int
    seconds: float
    clips: dict[str, Values]

    def value(self, metric: str) -> float:
        """The mean over the clips."""
        return mean(value for values in self.clips.values() if (value := values[metric]) is not None)


def recipe_of(network: str, loss: str, clips: Sequence[Clip]) -> Recipe:
    """As many steps on any number of clips."""
    quick = recipe_for(network, BUDGET)
    if quick.crops:
        small = replace(quick, batch=16, crop=64)
        per_epoch = quick.crops[0] * sum(clip.frames for clip in clips) / small.batch
    else:
        small = replace(quick, crop=None)
        per_epoch = sum(clip.frames for clip in clips) / small.frames(training=True)
    return replace(small, epochs=max(1, round(STEPS[network] / per_epoch)), loss=LOSSES[loss] or quick.loss)


def run_once(folder: Path, clips: Sequence[Clip], network: str, loss: str, split: Split, seed: int) -> BudgetRun:
    """Train and judge; what is there already is kept."""
    dataset = Dataset(folder / split.profile)
    train_clips = dataset.clips("train")
    variant = AblationVariant(f"{network}-{loss}-{split.rooms}x{split.spp}", network, partial(create, network))
    own = folder / f"{variant.label}-{seed}"
    recipe = recipe_of(network, loss, train_clips)
    task = Task(variant.label, variant.create, recipe, BUDGET, dataset, own, folder / "accumulated", seed)
    entrant = entrant_of(variant, task, train_network(task))
    seconds = sum(sum(read_json(clip.path / "timing.json").values()) for clip in train_clips)
    return BudgetRun(network, loss, split.rooms, split.spp, seed, seconds, clip_means(entrant, clips, folder))


def over_seeds(runs: Sequence[BudgetRun], network: str, loss: str, split: Split, metric: str) -> tuple[float, float]:
    """Mean and half the range over the seeds."""
    values = [
        run.value(metric)
        for run in runs
        if (run.network, run.loss, run.rooms, run.spp) == (network, loss, split.rooms, split.spp)
    ]
    return mean(values), (max(values) - min(values)) / 2


def curve_table(runs: Sequence[BudgetRun]) -> str:
    """A row for each network and loss, a column for each split of the budget."""
    seconds = {split: mean(run.seconds for run in runs if (run.rooms, run.spp) == split) for split in SPLITS}
    heads = [f"{split.rooms} rooms, {split.spp} spp ({seconds[split]:.0f} s)" for split in SPLITS]
    rows = []
    for metric, network, loss in product(SHOWN, STEPS, LOSSES):
        cells = [over_seeds(runs, network, loss, split, metric) for split in SPLITS]
        shown = [f"{METRICS[metric].form.format(value)} ± {spread:.2g}" for value, spread in cells]
        rows.append([METRICS[metric].title, network, loss, *shown])
    return tabulate(rows, ["", "network", "loss", *heads], tablefmt="github", disable_numparse=True)


def curve_figure(runs: Sequence[BudgetRun]) -> Figure:
    """Quality against samples a reference, at a fixed budget."""
    figure, axes = plt.subplots(1, len(STEPS), figsize=(9, 4), dpi=DPI, layout="constrained")
    for axis, network in zip(axes, STEPS, strict=True):
        for loss in LOSSES:
            cells = [over_seeds(runs, network, loss, split, "psnr") for split in SPLITS]
            means, spreads = zip(*cells, strict=True)
            axis.errorbar([split.spp for split in SPLITS], means, spreads, fmt="o-", ms=4, capsize=3, label=loss)
        axis.set(xscale="log", title=network, xlabel="samples a pixel of references; rooms make up for it")
        axis.set_xticks([split.spp for split in SPLITS], [f"{split.spp}\n{split.rooms} rooms" for split in SPLITS])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].set_ylabel(METRICS["psnr"].title)
    axes[0].legend(title="loss", fontsize=8)
    return figure


def bench_references(data: Path, runs: Path, seeds: int) -> str:
    """Judge all splits of the budget on the test clips of `data`: RUNS/bench/references/ gets a table, plot and JSON.

    Returns the table. Raises BadInput for no seeds or a data set without test clips.
    """
    if seeds < 1:
        raise BadInput(f"{seeds} seeds train nothing: use 1 or more")
    clips = clips_of_one_spp(Dataset(data))
    folder = bench_folder(runs) / "references"
    for split in SPLITS:
        generate(folder / split.profile, split.profile, seed=0)
    combinations = [*product(range(seeds), STEPS, LOSSES, SPLITS)]
    done = [
        run_once(folder, clips, network, loss, split, seed)
        for seed, network, loss, split in tqdm(combinations, "budget curve", unit="training")
    ]
    save_figure(folder / "plot.png", curve_figure(done))
    table = curve_table(done)
    write_file(folder / "table.md", f"{table}\n".encode())
    content = {"schema": 1, "dataset": str(data), "device": device_in_words(), "steps": STEPS}
    write_json(folder / "results.json", content | {"rows": [asdict(run) for run in done]})
    return table
