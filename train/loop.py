"""The training loop, one for all networks: from a task to its weights, with a log and checkpoints on the way."""

import os
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from pathlib import Path

from lightning_fabric import Fabric
from tqdm import tqdm

from errors import BadInput, can_draw
from files import locked
from provenance import differences
from train.log import Log, loss_curve, sample_picture
from train.precision import fabric_here
from train.task import WEIGHTS_FILE, Task
from train.training import BEST_FILE, Training, load_checkpoint

SAVE_SECONDS = 60.0  # between checkpoints: what a kill loses at most


@contextmanager
def alone_in(folder: Path, fabric: Fabric) -> Iterator[None]:
    """Hold the lock of a training's folder, which the first of its processes takes for all; the others wait for it.

    Raises BadInput, in all of them, where another training has it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with locked(folder / ".lock") if fabric.is_global_zero else nullcontext(True) as ours:
        if not fabric.broadcast(ours):
            raise BadInput(f"another process is training in {folder}: wait for it or use another --runs")
        if fabric.is_global_zero:
            for half_written in folder.glob(".*.tmp"):  # by a training that was killed
                half_written.unlink()
        yield


def train_network(task: Task, save_seconds: float = SAVE_SECONDS) -> Path:
    """Train, or resume an interrupted training. Returns the path of the weights.

    Weights that other code or packages have made are kept, and a line reports it. Raises BadInput for unusable data,
    or where the folder contains another training.
    """
    fabric = fabric_here()
    task.check(fabric.world_size)
    weights = task.folder / WEIGHTS_FILE
    with alone_in(task.folder, fabric):  # before the checkpoint is read, which another process may be about to replace
        training = Training(task, load_checkpoint(task.folder))
        others = differences(training.made_by, training.made_by_here)
        outcome = f"trained, {weights}"
        if others and training.finished:
            outcome = f"trained with {others}, kept at {weights}; delete {task.folder} to train again"
        elif others and fabric.is_global_zero:
            print(f"{task.name}: begun with {others}, resumed with what is here; its weights name both")
        if task.specialised and fabric.is_global_zero:
            left_out = ", ".join(training.judged.denoiser.constants) or "nothing: all of its inputs vary"
            print(f"{task.name}: specialised to {task.data.path}, left out {left_out}")
        if fabric.is_global_zero:
            train_to_end(training, save_seconds)
        else:  # take part in every step and in every validation
            if not training.position.done:
                training.validate()
            for _ in training.steps():
                if training.validates:
                    training.validate()
        fabric.barrier()
    if not weights.exists():
        raise BadInput(f"{task.folder} has a finished training but no weights: delete it and train again")
    if fabric.is_global_zero:
        print(f"{task.name}: {outcome}")
    return weights


def train_to_end(training: Training, save_seconds: float) -> None:
    """Take the remaining steps, with a log and checkpoints; then the best weights become the training's."""
    folder, name = training.task.folder, training.task.name
    if not training.finished:
        take_steps(training, save_seconds)
    if (folder / BEST_FILE).exists():  # only a finished training has weights
        if can_draw():
            loss_curve(folder, f"{name}, {training.task.budget}")
        else:
            print(f"{name}: no loss.png: it needs `pip install 'onespp[report]'`")
        os.replace(folder / BEST_FILE, folder / WEIGHTS_FILE)


def take_steps(training: Training, save_seconds: float) -> None:
    """Train to the last step; keep the best weights by validation, write the log, and a checkpoint every so often."""
    position = training.position
    if not position.done:
        training.keep_best(training.validate())  # the start: nothing trained may be worse
        training.save()  # so that a training killed at once keeps its precision
    label = f"{training.task.name} ({training.precision})"
    saved = time.monotonic()
    with (
        closing(Log(training.task.folder, position.done, training.total)) as log,
        tqdm(total=training.total, initial=position.done, desc=label, unit="step") as bar,
    ):
        for row in training.steps():
            skipped = f", skipped {position.skipped}" if position.skipped else ""
            losses = f"loss {row['loss']:.4f}, best on validation {position.best:.4f}"
            bar.set_postfix_str(f"{losses}, {row['step_ms']:.0f} ms{skipped}", refresh=False)
            bar.update()
            validation = training.validate() if training.validates else None
            log.add(position.done, {**row, "skipped": position.skipped}, validation)
            if validation is not None:
                training.keep_best(validation)
                with training.fabric.autocast():
                    picture = sample_picture(training.judged.denoiser, training.clips["val"][0], training.fabric.device)
                log.picture(position.done, picture)
            if time.monotonic() - saved > save_seconds or training.finished:
                training.save()
                saved = time.monotonic()
