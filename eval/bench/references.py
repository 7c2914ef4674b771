"""`onespp bench references`: what a render budget is best spent on, many rooms with noisy references or few with clean.

Noise2Noise (Lehtinen et al. 2018, §3.2, the table of budgets) asked it of still images; here it is asked of temporal
denoisers at one sample a pixel.
"""

from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
from tabulate import tabulate
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.generate import generate
from errors import BadInput
from eval.ablation.definitions import AblationVariant
from eval.ablation.run import entrant_of, trained_run
from eval.ablation.summary import seed_mean_text
from eval.ablation.variant_run import VariantRun, over_seeds
from eval.bench.output import bench_folder
from eval.harness import clips_of_one_spp
from eval.metrics import METRICS
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


class Way(NamedTuple):
    """A network, a loss and a split of the budget: what is trained once for each seed."""

    network: str
    loss: str
    split: Split

    @property
    def label(self) -> str:
        return f"{self.network}-{self.loss}-{self.split.rooms}x{self.split.spp}"


WAYS = tuple(Way(*way) for way in product(STEPS, LOSSES, SPLITS))


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


def render_seconds(dataset: Dataset) -> float:
    """What the rooms to train on took to render."""
    return sum(sum(read_json(clip.path / "timing.json").values()) for clip in dataset.clips("train"))


def train_and_judge(way: Way, seed: int, clips: Sequence[Clip], folder: Path) -> VariantRun:
    """One training and its means on `clips`; what is there already is kept."""
    dataset = Dataset(folder / way.split.profile)
    variant = AblationVariant(way.label, way.network, partial(create, way.network))
    recipe = recipe_of(way.network, way.loss, dataset.clips("train"))
    own_folder = folder / f"{way.label}-{seed}"
    task = Task(way.label, variant.create, recipe, BUDGET, dataset, own_folder, folder / "accumulated", seed)
    return trained_run(variant, task, entrant_of(variant, task, train_network(task)), clips, folder)


def curve_table(runs: Sequence[VariantRun], seconds: Sequence[float]) -> str:
    """A row for each network and loss, a column for each split of the budget, which took so many seconds to render."""
    heads = [f"{split.rooms} rooms, {split.spp} spp ({s:.0f} s)" for split, s in zip(SPLITS, seconds, strict=True)]
    rows = [
        [METRICS[metric].title, network, loss]
        + [seed_mean_text(runs, Way(network, loss, split).label, metric) for split in SPLITS]
        for metric, network, loss in product(SHOWN, STEPS, LOSSES)
    ]
    return tabulate(rows, ["", "network", "loss", *heads], tablefmt="github", disable_numparse=True)


def curve_figure(runs: Sequence[VariantRun]) -> Figure:
    """Quality against samples a reference, at a fixed budget."""
    figure, axes = plt.subplots(1, len(STEPS), figsize=(9, 4), dpi=DPI, layout="constrained", squeeze=False)
    for axis, network in zip(axes[0], STEPS, strict=True):
        for loss in LOSSES:
            found = [over_seeds(runs, Way(network, loss, split).label, "psnr") for split in SPLITS]
            means, spreads = zip(*((each.mean, each.spread or 0.0) for each in found if each), strict=True)
            axis.errorbar([split.spp for split in SPLITS], means, spreads, fmt="o-", ms=4, capsize=3, label=loss)
        axis.set(xscale="log", title=network, xlabel="samples a pixel of references; rooms make up for it")
        axis.set_xticks([split.spp for split in SPLITS], [f"{split.spp}\n{split.rooms} rooms" for split in SPLITS])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel(METRICS["psnr"].title)
    axes[0, 0].legend(title="loss", fontsize=8)
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
    seconds = [render_seconds(Dataset(folder / split.profile)) for split in SPLITS]
    trainings = [*product(range(seeds), WAYS)]
    judged = [
        train_and_judge(way, seed, clips, folder) for seed, way in tqdm(trainings, "budget curve", unit="training")
    ]
    save_figure(folder / "plot.png", curve_figure(judged))
    table = curve_table(judged, seconds)
    write_file(folder / "table.md", f"{table}\n".encode())
    content = {"schema": 1, "dataset": str(data), "device": device_in_words(), "steps": STEPS}
    content |= {"seconds": {split.profile: s for split, s in zip(SPLITS, seconds, strict=True)}}
    write_json(folder / "results.json", content | {"rows": [asdict(run) for run in judged]})
    return table
