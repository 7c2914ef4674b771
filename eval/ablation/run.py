"""`onespp ablate`: train the variants of a published ablation alike, judge them on the test clips, compare."""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.frame import read_frame
from errors import BadInput
from eval.ablation.definitions import SHARE, Ablation, Variant, ablation_for
from eval.ablation.summary import Run, draw, report, verdicts
from eval.clip_run import Entrant
from eval.harness import clips_of_one_spp, evaluate_clip
from files import write_file, write_json
from models.denoiser import Denoiser
from models.weights import load_weights
from models.wskp import KernelPredictor
from plotting import save_figure
from provenance import DENOISING, device_in_words, versions
from train.checkpoint import CHECKPOINT_FILE, load_checkpoint
from train.log import METRICS_CSV, read_metrics
from train.loop import train_network
from train.task import Task

RESULTS, TABLE, PLOT = "results.json", "table.md", "plot.png"
WARM_UP, REPEATS = 3, 30  # of a timing


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


def trained(variant: Variant, weights: Path) -> Denoiser:
    """A variant ready to use, in float32 on every machine: networks are compared here, not precisions."""
    denoiser = variant.create()
    load_weights(denoiser, variant.label, weights)
    denoiser.prepare()
    return denoiser


@torch.inference_mode()
def fusion_ms(denoisers: Mapping[str, Denoiser], clip: Clip) -> dict[str, float]:
    """Median milliseconds of building and fusing the kernels of a frame of `clip`, without the network.

    Each in turn, so that drift of the machine hits all.
    """
    work = {}
    for label, denoiser in denoisers.items():
        assert isinstance(denoiser, KernelPredictor)
        frame = read_frame(clip, 0, denoiser.reads)
        after = denoiser.accumulate(frame, None)
        irradiance = after.history.irradiance
        predicted = denoiser.network(denoiser.features(frame, irradiance, after.scale))
        work[label] = partial(denoiser.reconstruct, irradiance, predicted)
    seconds: dict[str, list[float]] = {label: [] for label in work}
    for _ in tqdm(range(WARM_UP + REPEATS), "timing", leave=False):
        for label, run in work.items():
            start = time.perf_counter()
            run()
            seconds[label].append(time.perf_counter() - start)
    return {label: 1e3 * float(np.median(times[WARM_UP:])) for label, times in seconds.items()}


def judge(name: str, denoiser: Denoiser, weights: Path, clips: Sequence[Clip], folder: Path) -> dict[str, Any]:
    """Means of the harness's metrics on each clip. What was judged before is kept, with pictures, in folder/eval."""
    kind = type(denoiser)
    entrant = Entrant(name, denoiser.signal, "float32", weights, (kind.__module__,), lambda: denoiser)
    results = [evaluate_clip(clip, [entrant], folder)[0] for clip in clips]
    return {f"{result.scene}/{result.clip}": result.metrics for result in results}


def train_and_judge(ablation: Ablation, tasks: Mapping[tuple[str, int], Task], folder: Path) -> list[Run]:
    """Train what is not trained yet, all in the precision that the first one found the fastest, and judge it."""
    variants = {variant.label: variant for variant in ablation.variants}
    clips = clips_to_judge(next(iter(tasks.values())).data, ablation)
    runs, networks = [], {}
    precision: str | None = None
    for (label, seed), task in tqdm(tasks.items(), folder.name, unit="network"):
        weights = train_network(replace(task, precision=precision))
        precision = load_checkpoint(task.folder / CHECKPOINT_FILE)["precision"]
        denoiser = networks[label] = trained(variants[label], weights)
        losses = epoch_losses(task.folder / METRICS_CSV, task.recipe.epochs)
        parameters = task.create().parameter_count()  # as trained
        runs.append(Run(label, seed, parameters, losses, judge(task.folder.name, denoiser, weights, clips, folder)))
    if ablation.timed:
        times = fusion_ms(networks, clips[0])
        for run in runs:
            run.fusion_ms = times[run.variant]
    return runs


def tasks_of(ablation: Ablation, data: Path, folder: Path, profile: str, seeds: int) -> dict[tuple[str, int], Task]:
    """The trainings of an ablation by label and seed, each in folder/LABEL-SEED, with all accumulated frames shared."""
    dataset, cache = Dataset(data), folder.parent.parent / "accumulated"
    return {
        (v.label, seed): Task(
            *(v.label, v.create, v.recipe(profile), profile, dataset), folder / f"{v.label}-{seed}", cache, seed
        )
        for seed in range(seeds)
        for v in ablation.variants
    }


def ablate(what: str, data: Path, runs: Path, profile: str, seeds: int = 1) -> str:
    """Run an ablation, or go on with it: RUNS/ablation/WHAT/ gets results.json, table.md and plot.png.

    Returns the table. Raises BadInput for an unknown ablation or profile, no seeds, or unusable data.
    """
    ablation, folder = ablation_for(what), runs / "ablation" / what
    if seeds < 1:
        raise BadInput(f"{seeds} seeds train nothing: use 1 or more")
    tasks = tasks_of(ablation, data, folder, profile, seeds)
    folder.mkdir(parents=True, exist_ok=True)
    results = train_and_judge(ablation, tasks, folder)

    epochs, clips = next(iter(tasks.values())).recipe.epochs, ", ".join(results[0].clips)
    title = f"{what}, after {ablation.source}\n"
    title += f"profile {profile}, {epochs} epochs ({SHARE:.0%} of its own), seeds: {seeds}, judged on {clips}"
    save_figure(folder / PLOT, draw(ablation, results, title))
    write_file(folder / TABLE, f"{title}\n\n{report(ablation, results, 'github')}\n".encode())
    facts = {
        "schema": 1,
        "what": what,
        "dataset": str(data),
        "device": device_in_words(),
        "versions": versions(DENOISING),
    }
    budget = {"profile": profile, "epochs": epochs, "share_of_epochs": SHARE, "seeds": seeds}
    found = {"rows": [vars(run) for run in results], "findings": verdicts(ablation, results)}
    write_json(folder / RESULTS, facts | budget | found)
    return f"{title}\n\n{report(ablation, results)}"
