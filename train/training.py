"""A training: a network, its optimiser and data, and its steps."""

import io
import math
import time
from collections.abc import Iterable, Iterator
from copy import deepcopy
from dataclasses import MISSING, asdict, dataclass, fields
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grads_with_norm_, get_total_norm
from torch.optim.swa_utils import get_ema_multi_avg_fn

from datasets.clip import digest_of
from errors import BadInput
from files import write_file
from models.weights import save_weights
from provenance import MadeBy, file_digest, made_by_here
from train.crops import AnyBatch
from train.data import equal_parts, items, largest_micro_batch, load_ahead, micro_batches
from train.log import LogRow
from train.losses.network_loss import NetworkLoss
from train.precision import fabric_here
from train.task import Recipe, Task

BEST_FILE = "best.safetensors"
CHECKPOINT_FILE = "checkpoint.pt"
VALIDATIONS = 10  # in a training
MAX_SKIPPED_IN_A_ROW = 20

RECIPE_DEFAULTS = {field.name: field.default for field in fields(Recipe) if field.default is not MISSING}

Checkpoint = dict[str, Any]  # all that an interrupted training needs to resume


def load_checkpoint(folder: Path) -> Checkpoint:
    """The checkpoint of the training in `folder`; empty where there is none. Raises BadInput where it is damaged."""
    path = folder / CHECKPOINT_FILE
    if not path.exists():
        return {}
    try:
        return dict(torch.load(path, weights_only=True, map_location="cpu"))
    except OSError:
        raise
    except Exception as error:  # a damaged pickle may fail in any way
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise BadInput(f"{path} is damaged ({reason}): delete {folder}") from None


def average_decay(updates: int, span: float) -> float:
    """The decay of the exponential average of weights, when those after update number `updates`, from 1, join it.

    1 - 1 / `span` in the long run, the mean of about the last `span` updates; less at first, lest the average keep
    the weights that the training began with.
    """
    return min(1 - 1 / max(span, 1), (1 + updates) / (10 + updates))


@torch.no_grad()
def update_average(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Move the weights of `average` to those of `network` by 1 - `decay` of the way."""
    get_ema_multi_avg_fn(decay)(list(average.parameters()), list(network.parameters()), None)


@dataclass
class Position:
    """How far a training has come."""

    done: int = 0  # steps
    best: float = math.inf  # mean loss over the validation clips
    skipped: int = 0  # steps whose loss or gradient was not finite
    skipped_in_a_row: int = 0


class Training:
    """One run: network, optimiser, data and position. Everything random follows from (seed, epoch, item).

    `judged` is what is validated and saved: the average of the weights where the recipe has one, else the weights.

    Resumes from the checkpoint `saved`, if there is one. Raises BadInput where that is of another training, or for
    unusable data.
    """

    def __init__(self, task: Task, saved: Checkpoint | None = None):
        self.task = task
        self.recipe = task.recipe
        torch.backends.mkldnn.deterministic = True  # type: ignore[assignment]
        torch.manual_seed(task.seed)
        self.clips = {split: task.data.clips(split) for split in ("train", "val")}
        clips = [*self.clips["train"], *self.clips["val"]]
        denoiser = task.network(clips)
        loss = NetworkLoss(denoiser, self.recipe.loss)
        fabric = fabric_here()
        with fabric.rank_zero_first():  # the others find the accumulated frames that the first has cached
            make = partial(items, recipe=self.recipe, denoiser=denoiser, seed=task.seed, cache=task.cache)
            self.items = make(self.clips["train"], training=True)
            self.val_items = make(self.clips["val"], training=False)
        self.micro_batch = task.micro_batch or largest_micro_batch(self.recipe, self.clips["train"][0])
        self.parts = len(equal_parts(self.recipe.batch // fabric.world_size, self.micro_batch))
        self.per_epoch = max(1, round(len(self.items) / self.recipe.batch))
        self.total = self.recipe.epochs * self.per_epoch
        self.position = Position()

        self.precision: str = fabric.broadcast(self.choose_precision(saved))
        self.fabric = fabric_here(self.precision)
        optimiser = torch.optim.Adam(denoiser.parameters(), lr=self.recipe.learning_rate(0), betas=self.recipe.betas)
        self.loss, self.optimiser = self.fabric.setup(loss, optimiser)
        self.judged: NetworkLoss = self.loss.module
        if self.recipe.average:
            self.judged = NetworkLoss(deepcopy(denoiser), self.recipe.loss).to(self.fabric.device)
        data = {key: task.data.facts[key] for key in ("profile", "seed", "generator", "scenes")}
        self.facts: dict[str, Any] = {
            "budget": task.budget,
            "seed": task.seed,
            "data": data | {"clips": digest_of(clips)},
            **asdict(self.recipe),
            "loss": {"name": type(self.recipe.loss).__name__, **asdict(self.recipe.loss)},
            "parameters": denoiser.parameter_count(),
        }
        if task.start:
            self.facts["from"] = file_digest(task.start)
        if denoiser.constants:
            self.facts["constants"] = denoiser.constants
        self.made_by: list[MadeBy] = saved["made_by"] if saved else []
        self.made_by_here = made_by_here("train.loop", type(loss.loss).__module__, type(denoiser).__module__)
        if saved:
            self.resume(saved)
        if not self.finished and self.made_by_here not in self.made_by:
            self.made_by = [*self.made_by, self.made_by_here]

    @property
    def finished(self) -> bool:
        return self.position.done >= self.total

    @property
    def validates(self) -> bool:
        """Whether validation follows the step just taken."""
        return self.finished or self.position.done % max(1, self.total // VALIDATIONS) == 0

    def choose_precision(self, saved: Checkpoint | None) -> str:
        """That of the task; a resumed training keeps its precision."""
        wanted = self.task.precision
        if not saved:
            return wanted or self.task.usual_precision
        kept: str = saved["precision"]
        if wanted and kept != wanted:
            raise BadInput(f"{self.task.folder} has a training in {kept}: delete it or use another --runs")
        return kept

    def resume(self, saved: Checkpoint) -> None:
        # What recipes have got since the checkpoint was written was as it is by default; losses had no names, and clips
        # no digest.
        facts = RECIPE_DEFAULTS | saved.get("facts", {})
        facts["data"] = {"clips": self.facts["data"]["clips"]} | facts.get("data", {})
        facts["loss"] = {"name": self.facts["loss"]["name"]} | facts.get("loss", {})
        if facts != self.facts:
            raise BadInput(
                f"{self.task.folder} has a training with another recipe, seed, data set or start: delete it or use "
                "another --runs"
            )
        self.loss.load_state_dict(saved["loss"])
        self.judged.load_state_dict(saved["judged"])
        self.optimiser.load_state_dict(saved["optimiser"])
        self.position = Position(**{field.name: saved[field.name] for field in fields(Position)})

    def save(self) -> None:
        """Write the checkpoint atomically: a full disk or a kill leaves the previous one."""
        content = {
            "facts": self.facts,
            "precision": self.precision,
            "made_by": self.made_by,
            "loss": self.loss.state_dict(),
            "judged": self.judged.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            **asdict(self.position),
        }
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_file(self.task.folder / CHECKPOINT_FILE, buffer.getvalue())

    def steps(self) -> Iterator[LogRow]:
        """Update the weights step by step until the last epoch's end; yields the log row of each step."""
        rank = self.fabric.global_rank
        world = self.fabric.world_size
        while not self.finished:
            epoch, first = divmod(self.position.done, self.per_epoch)
            self.items.epoch = epoch
            batches = micro_batches(first, self.per_epoch, self.recipe.batch, self.micro_batch, rank, world)
            loaded = load_ahead(self.items, batches)
            for _ in range(len(batches) // self.parts):
                row = self.step(islice(loaded, self.parts))
                self.position.done += 1
                yield row

    def step(self, batch: Iterable[AnyBatch]) -> LogRow:
        """Update the weights once. Returns the learning rate, the losses, the gradients' norm, and milliseconds."""
        start = time.perf_counter()
        ready = start
        loading = 0.0
        rate = self.recipe.learning_rate(self.position.done / self.per_epoch)
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.loss.module.progress = self.position.done / self.total
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
        norm = self.update(values["loss"])
        times = {"step_ms": 1e3 * (time.perf_counter() - start), "loading_ms": 1e3 * loading}
        return {"learning_rate": rate, **values, "gradient_norm": norm, **times}

    def reduce(self, value: Tensor, how: str) -> Tensor:
        """The mean or sum of every process's `value`."""
        reduced = self.fabric.all_reduce(value, reduce_op=how)
        assert isinstance(reduced, Tensor)
        return reduced

    def update(self, loss: float) -> float:
        """Apply the gradients, unless they or the loss are not finite. Every process comes to the same decision.

        Returns the norm of the gradients before clipping. Raises BadInput after too many skipped steps in a row.
        """
        parameters = list(self.loss.parameters())
        norm = get_total_norm([parameter.grad for parameter in parameters if parameter.grad is not None])
        if math.isfinite(loss) and torch.isfinite(norm):
            if self.recipe.clip is not None:
                clip_grads_with_norm_(parameters, self.recipe.clip, norm)
            self.position.skipped_in_a_row = 0
            self.optimiser.step()
            if self.recipe.average:
                updates = self.position.done - self.position.skipped + 1
                decay = average_decay(updates, self.recipe.average * self.total)
                update_average(self.judged, self.loss.module, decay)
        else:
            self.position.skipped += 1
            self.position.skipped_in_a_row += 1
            if self.position.skipped_in_a_row >= MAX_SKIPPED_IN_A_ROW:
                raise BadInput(
                    f"loss or gradient was not finite in {self.position.skipped_in_a_row} steps in a row: check the "
                    f"data with `onespp verify` and `onespp info`, or delete {self.task.folder} and train with "
                    "--precision float32"
                )
        self.optimiser.zero_grad()
        return float(norm)

    @torch.no_grad()
    def validate(self) -> float:
        """Mean loss over the validation clips, always the same crops."""
        numbers = range(len(self.val_items))
        batches = [list(numbers[i : i + self.micro_batch]) for i in range(0, len(numbers), self.micro_batch)]
        batches = batches[self.fabric.global_rank :: self.fabric.world_size]
        network = self.judged.eval()  # not through DDP: processes may have different numbers of batches
        total = torch.zeros(2, device=self.fabric.device)
        for chosen in batches:
            batch = self.val_items.batch(chosen).to(self.fabric.device)
            with self.fabric.autocast():
                loss, _ = network(batch)
            total += len(chosen) * torch.stack([loss, torch.ones_like(loss)])
        network.train()
        total = self.reduce(total, "sum")
        return float(total[0] / total[1])

    def keep_best(self, validation: float) -> None:
        """Write the weights if their loss over the validation clips is the lowest so far."""
        if validation < self.position.best:  # never true of NaN
            self.position.best = validation
            facts = {**self.facts, "step": self.position.done, "validation": validation}
            save_weights(self.judged.denoiser, self.task.name, facts, self.task.folder / BEST_FILE, self.made_by)
