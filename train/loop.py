"""The training loop, one for all networks."""

import io
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor
from torch.utils.data import DataLoader
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from datasets.clip import Clip, Dataset
from datasets.files import locked, write_file
from datasets.sequences import Augmentation, Batch, TrainingSequences, collate
from errors import BadInput
from models import create
from models.precision import fastest_precision
from models.weights import save_weights
from train.losses import loss_for
from train.recipes import Recipe, recipe_for

CHECKPOINT, BEST, WEIGHTS = "checkpoint.pt", "best.safetensors", "weights.safetensors"
VALIDATIONS = 10  # in a training, besides the last epoch
MOST_SKIPPED_IN_A_ROW = 20
COUNTERS = ("epoch", "best", "skipped", "skipped_in_a_row")


def run_folder(runs: Path, name: str, profile: str) -> Path:
    """Where the training of a denoiser in a profile keeps its checkpoint, curves and weights."""
    return runs / "train" / f"{name}-{profile}"


def loader(
    clips: list[Clip], recipe: Recipe, reads: tuple[str, ...], augment: bool, seed: int, workers: int = 0
) -> DataLoader[Batch]:
    augmentation = recipe.augmentation if augment else Augmentation()
    sequences = TrainingSequences(clips, reads, recipe.length, recipe.crop, augmentation, seed)
    # A smaller last batch would weigh its sequences more (and single ones are not reproducible bit for bit on CPUs).
    whole = len(sequences) >= recipe.batch
    return DataLoader(sequences, recipe.batch, collate_fn=collate, drop_last=whole, num_workers=workers)  # type: ignore[arg-type]


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Raises BadInput where the file is damaged."""
    try:
        return dict(torch.load(path, weights_only=True))
    except (RuntimeError, EOFError, UnpicklingError, ValueError, TypeError) as error:
        raise BadInput(f"{path} is damaged ({str(error).splitlines()[0]}): delete {path.parent}") from None


class Training:
    """One run: network, optimiser, data, and where it stands. Everything random follows from (seed, epoch, item)."""

    def __init__(self, name: str, data: Path, runs: Path, profile: str, seed: int, precision: str | None):
        self.name, self.recipe = name, recipe_for(name, profile)
        self.folder = run_folder(runs, name, profile)
        dataset = Dataset(data)
        torch.manual_seed(seed)
        denoiser = create(name)
        self.train_data = loader(dataset.clips("train"), self.recipe, denoiser.reads, True, seed)
        self.val_data = loader(dataset.clips("val"), self.recipe, denoiser.reads, False, seed)

        checkpoint = self.folder / CHECKPOINT
        saved = load_checkpoint(checkpoint) if checkpoint.exists() else {}
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
        # A resumed run keeps its precision, however the measurement would turn out this time.
        if saved and precision and saved.get("precision") != precision:
            raise BadInput(
                f"{self.folder} holds a training in {saved.get('precision')}: delete it or use another --runs"
            )
        self.precision = saved.get("precision") or precision or fastest_precision(torch.device(accelerator))
        self.fabric = Fabric(accelerator=accelerator, devices=1, precision=self.precision)  # type: ignore[arg-type]
        loss = loss_for(denoiser, name)
        optimiser = torch.optim.Adam(denoiser.parameters(), lr=self.recipe.learning_rate(0), betas=self.recipe.betas)
        self.loss, self.optimiser = self.fabric.setup(loss, optimiser)

        made_with = {key: dataset.facts[key] for key in ("profile", "seed", "generator", "scenes")}
        self.facts = {"profile": profile, "seed": seed, "data": made_with, **asdict(self.recipe)}
        self.facts["parameters"] = denoiser.parameter_count()
        self.epoch, self.best, self.skipped, self.skipped_in_a_row = 0, float("inf"), 0, 0
        if saved:
            self.resume(saved)

    def resume(self, saved: dict[str, Any]) -> None:
        if saved.get("facts") != self.facts:
            raise BadInput(
                f"{self.folder} holds a training with another recipe, seed or data set: delete it or use another --runs"
            )
        self.loss.load_state_dict(saved["loss"])
        self.optimiser.load_state_dict(saved["optimiser"])
        for key in COUNTERS:
            setattr(self, key, saved[key])

    def save(self) -> None:
        """Write the checkpoint atomically: a full disk or a kill leaves the previous one."""
        content = {
            "facts": self.facts,
            "precision": self.precision,
            "loss": self.loss.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            **{key: getattr(self, key) for key in COUNTERS},
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_file(self.folder / CHECKPOINT, buffer.getvalue())

    def steps(self) -> Iterator[tuple[float, dict[str, Tensor]]]:
        """One epoch: update the weights batch by batch; yields learning rate and losses of each step."""
        count = len(self.train_data)
        self.train_data.dataset.set_epoch(self.epoch)  # type: ignore[attr-defined]
        for index, batch in enumerate(self.train_data):
            rate = self.recipe.learning_rate(self.epoch + index / count)
            for group in self.optimiser.param_groups:
                group["lr"] = rate
            yield rate, self.step(batch)

    def step(self, batch: Batch) -> dict[str, Tensor]:
        """Update the weights once. Returns the loss and its parts."""
        loss, parts = self.loss(batch.to(self.fabric.device))
        self.fabric.backward(loss)
        gradients = [parameter.grad for parameter in self.loss.parameters() if parameter.grad is not None]
        if torch.isfinite(loss) and torch.isfinite(torch.nn.utils.get_total_norm(gradients)):
            self.skipped_in_a_row = 0
            self.optimiser.step()
        else:
            self.skip_step()
        self.optimiser.zero_grad()
        return {"loss": loss.detach(), **parts}

    def skip_step(self) -> None:
        """Count a step whose loss or gradient was not finite. Raises BadInput where they do not stop."""
        self.skipped += 1
        self.skipped_in_a_row += 1
        if self.skipped_in_a_row >= MOST_SKIPPED_IN_A_ROW:
            raise BadInput(
                f"loss or gradient was not finite in {self.skipped_in_a_row} steps in a row: check the data with "
                f"`onespp verify` and `onespp info`, or delete {self.folder} and train with --precision 32-true"
            )

    @torch.no_grad()
    def validate(self) -> float:
        """Mean loss over the validation clips, always the same crops."""
        losses = [self.loss(batch.to(self.fabric.device))[0].item() for batch in self.val_data]
        return sum(losses) / len(losses)

    def keep_best(self, validation: float) -> None:
        if validation < self.best:  # never true of NaN
            self.best = validation
            denoiser = self.loss.module.denoiser
            save_weights(
                denoiser, self.name, {**self.facts, "epoch": self.epoch, "validation": validation}, self.folder / BEST
            )


def run(training: Training) -> None:
    """Train until the recipe's last epoch, with a checkpoint after each, and keep the best weights by validation."""
    epochs, steps = training.recipe.epochs, len(training.train_data)
    every = max(1, epochs // VALIDATIONS)
    done = training.epoch * steps
    label = f"{training.name} ({training.precision})"
    with (
        SummaryWriter(str(training.folder), purge_step=done) as board,
        tqdm(total=epochs * steps, initial=done, desc=label, unit="step") as bar,
    ):
        while training.epoch < epochs:
            for rate, parts in training.steps():
                board.add_scalar("learning_rate", rate, bar.n)
                for part, value in parts.items():
                    board.add_scalar(f"train/{part}", value, bar.n)
                bar.set_postfix(loss=f"{parts['loss']:.3f}", val=f"{training.best:.3f}", skipped=training.skipped)
                bar.update()
            training.epoch += 1
            if training.epoch % every == 0 or training.epoch == epochs:
                validation = training.validate()
                board.add_scalar("val/loss", validation, bar.n)
                training.keep_best(validation)
            training.save()


def train(name: str, data: Path, runs: Path, profile: str, seed: int = 0, precision: str | None = None) -> Path:
    """Train a denoiser, or go on where an interrupted training stopped. Returns the path of its weights.

    Args:
        name: the denoiser. data: the data set's folder. runs: where `train/NAME-PROFILE/` is written.
        precision: Fabric's name of one, by default the fastest here.
    Raises BadInput for an unknown name or profile, unusable data, or a run of another recipe in the folder.
    """
    training = Training(name, data, runs, profile, seed, precision)
    training.folder.mkdir(parents=True, exist_ok=True)
    best, weights = training.folder / BEST, training.folder / WEIGHTS
    with locked(training.folder / ".lock") as ours:
        if not ours:
            raise BadInput(f"another process is training in {training.folder}: wait for it or use another --runs")
        if training.epoch < training.recipe.epochs:
            run(training)
        if best.exists():  # only a finished training has WEIGHTS
            os.replace(best, weights)
    if not weights.exists():
        raise BadInput(f"{training.folder} holds a finished training but no weights: delete it and train again")
    return weights
