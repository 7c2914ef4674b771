"""The training loop, one for all networks."""

import io
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor
from tqdm import tqdm

from datasets.clip import Dataset
from errors import BadInput
from files import locked, write_file
from models.denoiser import Denoiser
from models.registry import create
from models.weights import save_weights
from train.data import in_parts, items, loader, micro_batches, most_at_once, split
from train.log import Log, logging, loss_curve, sample_picture
from train.losses import NetworkLoss, loss_for
from train.precision import fastest_precision
from train.recipes import Recipe, recipe_for

CHECKPOINT, BEST, WEIGHTS = "checkpoint.pt", "best.safetensors", "weights.safetensors"
VALIDATIONS = 10  # in a training
SAVE_SECONDS = 60.0  # between checkpoints: what a kill loses at most
MOST_SKIPPED_IN_A_ROW = 20
COUNTERS = ("done", "best", "skipped", "skipped_in_a_row")


def run_folder(runs: Path, name: str, profile: str) -> Path:
    """Where the training of a denoiser in a profile keeps its checkpoint, curves and weights."""
    return runs / "train" / f"{name}-{profile}"


@dataclass(frozen=True)
class Task:
    """What is trained, on what, and where that is kept. `create` makes the network with fresh weights."""

    name: str
    create: Callable[[], Denoiser]
    recipe: Recipe
    profile: str
    data: Dataset
    folder: Path  # of this training
    cache: Path  # of accumulated frames, which trainings share
    seed: int = 0
    precision: str | None = None  # Fabric's name of one; by default the fastest here
    at_once: int | None = None  # items in memory together; by default what fits a few gigabytes


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Raises BadInput where the file is damaged."""
    try:
        return dict(torch.load(path, weights_only=True, map_location="cpu"))
    except (RuntimeError, EOFError, UnpicklingError, ValueError, TypeError) as error:
        raise BadInput(f"{path} is damaged ({str(error).splitlines()[0]}): delete {path.parent}") from None


def fabric_here(precision: str = "32-true") -> Fabric:
    """Fabric for this machine: one GPU or the CPU, or under torchrun as many processes as that has started (DDP)."""
    accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    here, world = (int(os.environ.get(name, 1)) for name in ("LOCAL_WORLD_SIZE", "WORLD_SIZE"))
    strategy = "ddp" if world > 1 else "auto"
    nodes = world // here
    fabric = Fabric(accelerator=accelerator, strategy=strategy, devices=here, num_nodes=nodes, precision=precision)  # type: ignore[arg-type]
    fabric.launch()
    return fabric


class Training:
    """One run: network, optimiser, data, and where it stands. Everything random follows from (seed, epoch, item)."""

    def __init__(self, task: Task):
        self.task, self.recipe, self.folder = task, task.recipe, task.folder
        torch.backends.mkldnn.deterministic = True  # type: ignore[assignment]
        torch.manual_seed(task.seed)
        denoiser = task.create()
        loss = loss_for(denoiser, self.recipe)
        fabric = fabric_here()
        self.share_work(fabric.world_size)
        with fabric.rank_zero_first():  # the others find the accumulated frames that the first has cached
            self.clips = {split: task.data.clips(split) for split in ("train", "val")}
            make = partial(items, recipe=self.recipe, denoiser=denoiser, seed=task.seed, cache=task.cache)
            self.items, self.val_items = (
                make(self.clips["train"], training=True),
                make(self.clips["val"], training=False),
            )
        self.per_epoch = max(1, round(len(self.items) / self.recipe.batch))
        self.total = self.recipe.epochs * self.per_epoch
        self.done, self.best, self.skipped, self.skipped_in_a_row = 0, float("inf"), 0, 0

        saved = load_checkpoint(self.folder / CHECKPOINT) if (self.folder / CHECKPOINT).exists() else {}
        self.precision = fabric.broadcast(self.choose_precision(loss, saved, fabric))
        self.fabric = fabric_here(self.precision)
        betas = self.recipe.betas
        optimiser = torch.optim.Adam(denoiser.parameters(), lr=self.recipe.learning_rate(0), betas=betas)
        self.loss, self.optimiser = self.fabric.setup(loss, optimiser)
        made_with = {key: task.data.facts[key] for key in ("profile", "seed", "generator", "scenes")}
        self.facts = {"profile": task.profile, "seed": task.seed, "data": made_with, **asdict(self.recipe)}
        self.facts["parameters"] = denoiser.parameter_count()
        if saved:
            self.resume(saved)

    def share_work(self, world: int) -> None:
        """Set how many parts this process's share of a batch comes in. Raises BadInput where it cannot be shared."""
        batch, at_once = self.recipe.batch, self.task.at_once
        if batch % world:
            raise BadInput(f"a batch of {batch} cannot be shared by {world} processes: start a divisor of {batch}")
        if at_once is not None and at_once < 1:
            raise BadInput(f"{at_once} items at once are none: use 1 or more")
        self.at_once = at_once or most_at_once(self.recipe, self.task.data.clips("train")[0])
        self.parts = len(split(batch // world, self.at_once))

    def choose_precision(self, loss: NetworkLoss, saved: dict[str, Any], fabric: Fabric) -> str:
        """A resumed run keeps its precision, however the measurement would turn out this time."""
        wanted = self.task.precision
        if saved and wanted and saved.get("precision") != wanted:
            raise BadInput(
                f"{self.folder} holds a training in {saved.get('precision')}: delete it or use another --runs"
            )
        if kept := saved.get("precision") or wanted:
            return str(kept)
        first = micro_batches(0, 1, self.recipe.batch, self.at_once, 0, fabric.world_size)[:1]
        return fastest_precision(loss, next(iter(loader(self.items, first))), fabric.device.type)

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

    def steps(self) -> Iterator[dict[str, float]]:
        """Update the weights step by step until the last epoch's end; yields what is worth noting of each step."""
        rank, world = self.fabric.global_rank, self.fabric.world_size
        while self.done < self.total:
            epoch, first = divmod(self.done, self.per_epoch)
            self.items.set_epoch(epoch)
            batches = micro_batches(first, self.per_epoch, self.recipe.batch, self.at_once, rank, world)
            for batch in in_parts(loader(self.items, batches), self.parts):
                noted = self.step(batch)
                self.done += 1
                yield noted

    def step(self, batch: Iterable[Any]) -> dict[str, float]:
        """Update the weights once, from the parts of a batch. Returns its loss, its terms, rate and milliseconds."""
        start = ready = time.perf_counter()
        loading = 0.0
        rate = self.recipe.learning_rate(self.done / self.per_epoch)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.loss.module.progress = self.done / self.total
        sums: dict[str, Tensor] = {}
        for index, part in enumerate(batch):
            loading += time.perf_counter() - ready
            with self.fabric.no_backward_sync(self.loss, enabled=index + 1 < self.parts):
                loss, terms = self.loss(part.to(self.fabric.device))
                self.fabric.backward(loss / self.parts)
            for name, term in {"loss": loss.detach(), **terms}.items():
                sums[name] = sums.get(name, torch.zeros_like(term)) + term / self.parts
            ready = time.perf_counter()
        values = {name: float(self.reduce(term, "mean")) for name, term in sums.items()}
        self.update(values["loss"])
        times = {"step_ms": 1e3 * (time.perf_counter() - start), "loading_ms": 1e3 * loading}
        return {"learning_rate": rate, **values, **times}

    def reduce(self, value: Tensor, how: str) -> Tensor:
        """The mean or sum of every process's `value`."""
        reduced = self.fabric.all_reduce(value, reduce_op=how)
        assert isinstance(reduced, Tensor)
        return reduced

    def update(self, loss: float) -> None:
        """Apply the gradients, unless they or the loss are not finite. Every process comes to the same decision."""
        gradients = [parameter.grad for parameter in self.loss.parameters() if parameter.grad is not None]
        if torch.isfinite(torch.tensor(loss)) and torch.isfinite(torch.nn.utils.get_total_norm(gradients)):
            self.skipped_in_a_row = 0
            self.optimiser.step()
        else:
            self.skip_step()
        self.optimiser.zero_grad()

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
        rank, world = self.fabric.global_rank, self.fabric.world_size
        numbers = range(len(self.val_items))
        batches = [list(numbers[i : i + self.at_once]) for i in range(0, len(numbers), self.at_once)][rank::world]
        network: NetworkLoss = self.loss.module.eval()  # not through DDP: processes may differ in how much they have
        total = torch.zeros(2, device=self.fabric.device)
        for batch, chosen in zip(loader(self.val_items, batches), batches, strict=True):
            with self.fabric.autocast():
                loss, _ = network(batch.to(self.fabric.device))
            total += len(chosen) * torch.stack([loss, torch.ones_like(loss)])
        network.train()
        total = self.reduce(total, "sum")
        return float(total[0] / total[1])

    def keep_best(self, validation: float) -> None:
        if validation < self.best:  # never true of NaN
            self.best = validation
            facts = {**self.facts, "step": self.done, "validation": validation}
            save_weights(self.loss.module.denoiser, self.task.name, facts, self.folder / BEST)


def run(training: Training) -> None:
    """Train to the end, and keep the best weights by validation. The first process writes checkpoints and the log."""
    every = max(1, training.total // VALIDATIONS)
    if not training.fabric.is_global_zero:
        for _ in training.steps():
            if training.done % every == 0 or training.done == training.total:
                training.validate()
        return
    if not training.done:
        training.save()  # so that a training killed at once keeps its precision
    label = f"{training.task.name} ({training.precision})"
    saved = time.monotonic()
    with (
        logging(training.folder, training.done, training.total) as log,
        tqdm(total=training.total, initial=training.done, desc=label, unit="step") as bar,
    ):
        for noted in training.steps():
            log.step({**noted, "skipped": training.skipped})
            bar.set_postfix_str(progress(training, noted), refresh=False)
            bar.update()
            if training.done % every == 0 or training.done == training.total:
                judge(training, log)
            log.write(training.done)
            if time.monotonic() - saved > SAVE_SECONDS or training.done == training.total:
                training.save()
                saved = time.monotonic()


def progress(training: Training, noted: dict[str, float]) -> str:
    loss = f"loss {noted['loss']:.4f}, best on validation {training.best:.4f}"
    return f"{loss}, {noted['step_ms']:.0f} ms" + f", skipped {training.skipped}" * (training.skipped > 0)


def judge(training: Training, log: Log) -> None:
    """Validate, keep the weights if they are the best, and show what they do."""
    validation = training.validate()
    training.keep_best(validation)
    log.write(training.done, {"val_loss": validation})
    denoiser, clip = training.loss.module.denoiser, training.clips["val"][0]
    with training.fabric.autocast():
        log.picture(training.done, sample_picture(denoiser, clip, training.fabric.device))


def train_network(task: Task) -> Path:
    """Train, or go on where an interrupted training stopped. Returns the path of the weights.

    Raises BadInput for unusable data, or where the folder holds another training.
    """
    training = Training(task)
    folder = training.folder
    best, weights = folder / BEST, folder / WEIGHTS
    folder.mkdir(parents=True, exist_ok=True)
    first = training.fabric.is_global_zero
    with locked(folder / ".lock") if first else nullcontext(True) as ours:
        if not ours:
            raise BadInput(f"another process is training in {folder}: wait for it or use another --runs")
        if training.done < training.total:
            run(training)
        if first and best.exists():  # only a finished training has WEIGHTS
            loss_curve(folder, f"{task.name}, {task.profile}")
            os.replace(best, weights)
    training.fabric.barrier()
    if not weights.exists():
        raise BadInput(f"{folder} holds a finished training but no weights: delete it and train again")
    if first:
        print(f"{task.name}: trained, {weights}")
    return weights


def task_for(
    name: str,
    data: Path,
    runs: Path,
    profile: str,
    seed: int = 0,
    precision: str | None = None,
    at_once: int | None = None,
) -> Task:
    """The training of a denoiser in a profile. Raises BadInput for an unknown name or profile, or no data set."""
    recipe, folder = recipe_for(name, profile), run_folder(runs, name, profile)
    network = partial(create, name)
    return Task(name, network, recipe, profile, Dataset(data), folder, runs / "accumulated", seed, precision, at_once)
