"""`onespp ablate`: train the variants of a published ablation alike, judge them on the test clips, compare."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.frame import read_frame
from errors import BadInput
from eval.ablation.definitions import SHARE_OF_EPOCHS, Ablation, AblationVariant, ablation_for
from eval.ablation.plots import ablation_figure
from eval.ablation.summary import ablation_table, judged_findings
from eval.ablation.variant_run import VariantRun
from eval.clip_run import Entrant
from eval.harness import clips_of_one_spp, evaluate_clip
from eval.metrics import Values
from files import write_file, write_json
from models.denoiser import Denoiser
from models.weights import load_weights
from models.wskp import KernelPredictor
from plotting import save_figure
from provenance import DENOISING, device_in_words, versions
from timing import take_turns
from train.checkpoint import load_checkpoint
from train.log import METRICS_CSV, read_metrics
from train.loop import train_network
from train.task import Task

Trainings = Sequence[tuple[AblationVariant, Task]]


def meshes_move(clip: Clip) -> bool:
    poses = (clip.view(frame).object_to_world for frame in range(clip.frames))
    first = next(poses)
    return any(not np.array_equal(first, pose) for pose in poses)


def clips_to_judge(dataset: Dataset, ablation: Ablation) -> list[Clip]:
    """The test clips of 1 spp, or those of them where meshes move. Raises BadInput where there are none."""
    clips = [clip for clip in clips_of_one_spp(dataset) if not ablation.moving or meshes_move(clip)]
    if not clips:
        raise BadInput(f"nothing moves in the test clips of {dataset.path}: use a data set with moving scenes")
    return clips


def epoch_losses(metrics: Path, epochs: int) -> list[float | None]:
    """Mean training loss of each epoch, from the metrics.csv of a finished training; None where it was not finite."""
    rows = read_metrics(metrics)
    losses: list[list[float]] = [[] for _ in range(epochs)]
    for row in rows:  # the last one is of the last step
        losses[math.ceil(row["step"] * epochs / rows[-1]["step"]) - 1].append(row["loss"])
    return [float(np.mean(finite)) if (finite := [x for x in epoch if math.isfinite(x)]) else None for epoch in losses]


def trained(variant: AblationVariant, weights: Path) -> Denoiser:
    """A variant ready to use, in float32 on every machine: networks are compared here, not precisions."""
    denoiser = variant.create()
    load_weights(denoiser, variant.label, weights)
    denoiser.prepare()
    return denoiser


def entrant_of(variant: AblationVariant, task: Task, weights: Path) -> Entrant:
    """A trained variant, to be evaluated under the name of its folder."""
    fresh = variant.create()
    return Entrant(
        name=task.folder.name,
        signal=fresh.signal,
        precision="float32",
        weights=weights,
        modules=(type(fresh).__module__,),
        build=partial(trained, variant, weights),
    )


def clip_means(entrant: Entrant, clips: Sequence[Clip], folder: Path) -> dict[str, Values]:
    """Means of the harness's metrics on each clip. What was judged before is kept, with pictures, in folder/eval."""
    results = [evaluate_clip(clip, [entrant], folder)[0] for clip in clips]
    return {f"{result.scene}/{result.clip}": result.metrics for result in results}


def trained_run(
    variant: AblationVariant, task: Task, entrant: Entrant, clips: Sequence[Clip], folder: Path
) -> VariantRun:
    """How a finished training went, and how it is judged on `clips`."""
    return VariantRun(
        variant=variant.label,
        seed=task.seed,
        parameters=variant.create().parameter_count(),  # as trained
        losses=epoch_losses(task.folder / METRICS_CSV, task.recipe.epochs),
        clips=clip_means(entrant, clips, folder),
    )


def fusion_of(denoiser: Denoiser, clip: Clip) -> Callable[[], tuple[Tensor, Tensor | None]]:
    """What builds and fuses a kernel predictor's kernels for the first frame of `clip`, without the network."""
    assert isinstance(denoiser, KernelPredictor)
    frame = read_frame(clip, 0, denoiser.reads)
    after = denoiser.accumulate(frame, None)
    irradiance = after.history.irradiance
    predicted = denoiser.network(denoiser.features(frame, irradiance, after.scale))
    return partial(denoiser.reconstruct, irradiance, predicted)


@torch.inference_mode()
def fusion_ms(denoisers: Mapping[str, Denoiser], clip: Clip, measured: int = 30, warm_up: int = 3) -> dict[str, float]:
    """Median milliseconds of building and fusing the kernels of a frame of `clip`, without the network."""
    work = {label: fusion_of(denoiser, clip) for label, denoiser in denoisers.items()}
    seconds = take_turns(work, measured, warm_up)
    return {label: 1e3 * float(np.median(times)) for label, times in seconds.items()}


def train_and_judge(ablation: Ablation, trainings: Trainings, clips: Sequence[Clip], folder: Path) -> list[VariantRun]:
    """Train what is not trained yet, all in the precision that the first one found the fastest, and judge it."""
    runs = []
    entrants: dict[str, Entrant] = {}
    precision: str | None = None
    for variant, task in tqdm(trainings, folder.name, unit="network"):
        weights = train_network(replace(task, precision=precision))
        precision = load_checkpoint(task.folder)["precision"]
        entrants[variant.label] = entrant_of(variant, task, weights)
        runs.append(trained_run(variant, task, entrants[variant.label], clips, folder))
    if not ablation.timed:
        return runs
    times = fusion_ms({label: entrant.denoiser for label, entrant in entrants.items()}, clips[0])
    return [replace(run, fusion_ms=times[run.variant]) for run in runs]


def trainings_of(ablation: Ablation, dataset: Dataset, folder: Path, budget: str, seeds: int) -> Trainings:
    """Each variant with each seed, each in folder/LABEL-SEED; all share accumulated frames with other trainings.

    Raises BadInput for an unknown budget.
    """
    accumulated = folder.parent.parent / "accumulated"

    def task(variant: AblationVariant, seed: int) -> Task:
        own_folder = folder / f"{variant.label}-{seed}"
        recipe = variant.recipe(budget)
        return Task(variant.label, variant.create, recipe, budget, dataset, own_folder, accumulated, seed)

    return [(variant, task(variant, seed)) for seed in range(seeds) for variant in ablation.variants]


def ablate(what: str, data: Path, runs: Path, budget: str, seeds: int = 1) -> str:
    """Run an ablation, or go on with it: RUNS/ablation/WHAT/ gets results.json, table.md and plot.png.

    Returns the table. Raises BadInput for an unknown ablation or budget, no seeds, or unusable data.
    """
    ablation = ablation_for(what)
    if seeds < 1:
        raise BadInput(f"{seeds} seeds train nothing: use 1 or more")
    folder = runs / "ablation" / what
    dataset = Dataset(data)
    trainings = trainings_of(ablation, dataset, folder, budget, seeds)
    clips = clips_to_judge(dataset, ablation)
    folder.mkdir(parents=True, exist_ok=True)
    judged = train_and_judge(ablation, trainings, clips, folder)

    epochs = trainings[0][1].recipe.epochs
    title = f"{what} ({ablation.source})\n"
    title += f"budget {budget}, {epochs} epochs ({SHARE_OF_EPOCHS:.0%} of its own), seeds: {seeds}, "
    title += f"judged on {', '.join(judged[0].clips)}"
    save_figure(folder / "plot.png", ablation_figure(ablation, judged, title))
    write_file(folder / "table.md", f"{title}\n\n{ablation_table(ablation, judged, 'github')}\n".encode())
    results = {
        "schema": 1,
        "what": what,
        "dataset": str(data),
        "device": device_in_words(),
        "versions": versions(DENOISING),
        "profile": budget,
        "epochs": epochs,
        "share_of_epochs": SHARE_OF_EPOCHS,
        "seeds": seeds,
        "rows": [asdict(run) for run in judged],
        "findings": [asdict(finding) for finding in judged_findings(ablation, judged)],
    }
    write_json(folder / "results.json", results)
    return f"{title}\n\n{ablation_table(ablation, judged)}"
