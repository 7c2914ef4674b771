"""The loop: it resumes to the same bits, skips what is not finite, survives a full disk, and shows what it does."""

import csv
import math
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.image import imread
from safetensors import safe_open

from errors import BadInput
from train import loop
from train.log import Log, read_metrics, smooth
from train.loop import Training, run_folder, task_for, train_network
from train.losses import RAELoss
from train.precision import fastest_precision
from train.recipes import RECIPES

FLOAT32 = "32-true"


def train(name: str, data: Path, runs: Path, seed: int = 0, precision: str | None = None) -> Path:
    return train_network(task_for(name, data, runs, "tiny", seed, precision))


@pytest.fixture
def short(monkeypatch):
    """Some ten steps in the tiny profile, whatever the network."""
    for name, epochs in (("rae", 4), ("wskp6", 1), ("ntd", 1)):
        monkeypatch.setitem(RECIPES, (name, "tiny"), replace(RECIPES[name, "tiny"], epochs=epochs))


def tensors(path: Path) -> dict[str, torch.Tensor]:
    with safe_open(path, "pt") as file:
        return {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118


def same(a: Path, b: Path) -> bool:
    x, y = tensors(a), tensors(b)
    return x.keys() == y.keys() and all(torch.equal(x[key], y[key]) for key in x)


def interrupt_after(monkeypatch, count: int) -> None:
    genuine = Training.steps

    def steps(self: Training) -> Iterator[dict[str, float]]:
        for number, step in enumerate(genuine(self)):
            if number == count:
                raise KeyboardInterrupt
            yield step

    monkeypatch.setattr(Training, "steps", steps)


@pytest.mark.parametrize("name", ["wskp6", *(pytest.param(name, marks=pytest.mark.slow) for name in ("rae", "ntd"))])
def test_interrupted_training_resumes_to_equal_weights(tiny, tmp_path, short, monkeypatch, name):
    """Interrupted in the middle of an epoch; the weights equal those of an undisturbed run bit for bit."""
    monkeypatch.setattr(loop, "SAVE_SECONDS", 0.0)
    whole = train(name, tiny, tmp_path / "whole", precision=FLOAT32)
    with monkeypatch.context() as patched:
        interrupt_after(patched, 5)
        with pytest.raises(KeyboardInterrupt):
            train(name, tiny, tmp_path / "resumed", precision=FLOAT32)
    assert not (run_folder(tmp_path / "resumed", name, "tiny") / "weights.safetensors").exists()
    resumed = train(name, tiny, tmp_path / "resumed", precision=FLOAT32)
    assert same(whole, resumed)
    rows = [read_metrics(path.parent / "metrics.csv") for path in (whole, resumed)]
    assert [r["loss"] for r in rows[0]] == [r["loss"] for r in rows[1]]
    assert [r["step"] for r in rows[0]] == list(range(1, len(rows[0]) + 1))


def test_a_finished_training_is_left_alone_and_another_refused(tiny, tmp_path, short):
    weights = train("rae", tiny, tmp_path, precision=FLOAT32)
    before = weights.stat().st_mtime_ns
    assert train("rae", tiny, tmp_path) == weights and weights.stat().st_mtime_ns == before
    with pytest.raises(BadInput, match="another recipe, seed or data set"):
        train("rae", tiny, tmp_path, seed=1)
    with pytest.raises(BadInput, match="a training in 32-true"):
        train("rae", tiny, tmp_path, precision="bf16-mixed")
    weights.unlink()
    with pytest.raises(BadInput, match="no weights"):
        train("rae", tiny, tmp_path)
    checkpoint = weights.with_name("checkpoint.pt")
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(BadInput, match=r"checkpoint.pt is damaged"):
        train("rae", tiny, tmp_path)


KILLED = """
import sys
from dataclasses import replace
from pathlib import Path
from train import loop
from train.recipes import RECIPES
loop.SAVE_SECONDS = 0.0
name, data, runs, epochs = sys.argv[1:]
RECIPES[name, "tiny"] = replace(RECIPES[name, "tiny"], epochs=int(epochs), crop=32)
loop.train_network(loop.task_for(name, Path(data), Path(runs), "tiny", precision="32-true"))
"""


def start(name: str, data: Path, runs: Path, epochs: int) -> "subprocess.Popen[bytes]":
    return subprocess.Popen(
        [sys.executable, "-c", KILLED, name, str(data), str(runs), str(epochs)], stderr=subprocess.DEVNULL
    )


def kill_once(name: str, data: Path, runs: Path, epochs: int, row: int) -> bool:
    """Start a training and SIGKILL it once its log has `row` rows. Returns whether it was still at work."""
    process, metrics = start(name, data, runs, epochs), run_folder(runs, name, "tiny") / "metrics.csv"
    while process.poll() is None and (not metrics.exists() or metrics.read_text().count("\n") < row):
        time.sleep(0.002)
    process.kill()
    return process.wait() == -signal.SIGKILL


@pytest.mark.parametrize(
    "name, epochs, rows",
    [
        ("ntd", 1, (4,)),
        *(
            pytest.param(name, epochs, range(3, 24, 2), marks=pytest.mark.slow)
            for name, epochs in (("rae", 15), ("wskp6", 2), ("ntd", 3))
        ),
    ],
)
def test_killed_training_ends_with_the_weights_of_an_undisturbed_one(tiny, tmp_path, name, epochs, rows):
    assert start(name, tiny, tmp_path / "whole", epochs).wait() == 0
    kills = [kill_once(name, tiny, tmp_path / "killed", epochs, row) for row in rows]
    assert any(kills)
    assert start(name, tiny, tmp_path / "killed", epochs).wait() == 0
    folders = [run_folder(tmp_path / which, name, "tiny") for which in ("whole", "killed")]
    assert same(*(folder / "weights.safetensors" for folder in folders))
    assert not [path for path in folders[1].iterdir() if path.suffix == ".tmp"]


def test_gradients_of_parts_add_up_to_those_of_the_batch(tiny, tmp_path, short):
    """Four sequences at once, two, and one: the same loss and weights up to rounding."""
    results = []
    for at_once in (4, 2, 1):
        training = Training(
            replace(task_for("rae", tiny, tmp_path / str(at_once), "tiny", precision=FLOAT32), at_once=at_once)
        )
        assert training.parts == 4 // at_once
        steps = training.steps()
        losses = [next(steps)["loss"] for _ in range(3)]
        results.append((losses, torch.cat([p.detach().flatten() for p in training.loss.parameters()])))
    for losses, weights in results[1:]:
        assert losses == pytest.approx(results[0][0], rel=1e-4)
        assert torch.dist(weights, results[0][1]) < 1e-3 * results[0][1].norm()
    with pytest.raises(BadInput, match="use 1 or more"):
        Training(replace(task_for("rae", tiny, tmp_path / "none", "tiny"), at_once=0))


def test_training_shows_what_it_does(tiny, tmp_path, short):
    weights = train("rae", tiny, tmp_path, precision="bf16-mixed")
    folder = weights.parent
    with safe_open(weights, "pt") as file:
        metadata = file.metadata()
    assert metadata["denoiser"] == "rae" and '"epochs": 4' in metadata["recipe"] and '"crop": 32' in metadata["recipe"]
    assert all(t.dtype == torch.float32 and torch.isfinite(t).all() for t in tensors(weights).values())
    assert list(folder.glob("events.out.tfevents.*"))
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    wanted = {
        "step",
        "learning_rate",
        "loss",
        "spatial",
        "gradient",
        "temporal",
        "skipped",
        "step_ms",
        "loading_ms",
        "val_loss",
    }
    assert set(rows[0]) == wanted and rows[-1]["val_loss"]
    assert imread(folder / "sample.png").shape[:2] == (64, 4 * 64)
    assert imread(folder / "loss.png").ndim == 3
    assert not (folder / ".lock").exists()


def test_a_log_averages_and_forgets_what_a_kill_left(tmp_path):
    log = Log(tmp_path, 0, 6000)  # three steps a row
    for step in range(1, 8):
        log.step({"loss": float(step)})
        log.write(step, {"val_loss": 9.0} if step == 7 else None)
    assert [(r["step"], r["loss"]) for r in read_metrics(log.path)] == [(3, 2.0), (6, 5.0), (7, 7.0)]
    assert read_metrics(log.path)[-1]["val_loss"] == 9.0
    with log.path.open("a") as file:
        file.write("9,8.0")  # cut off
    resumed = Log(tmp_path, 6, 6000)
    assert [r["step"] for r in read_metrics(resumed.path)] == [3, 6]
    assert smooth(np.ones((1001, 2))).shape[0] <= 210


def test_precision_is_measured(monkeypatch):
    """The faster one wins, whichever that is."""

    class Slow(torch.nn.Module):
        def __init__(self, slow: bool):
            super().__init__()
            self.slow, self.weight = slow, torch.nn.Parameter(torch.ones(()))

        def forward(self, batch):
            if torch.is_autocast_enabled("cpu") == self.slow:
                time.sleep(0.02)
            return self.weight * 1, {}

    class Nothing:
        def to(self, _):
            return self

    assert fastest_precision(Slow(True), Nothing(), "cpu") == "32-true"
    assert fastest_precision(Slow(False), Nothing(), "cpu") == "bf16-mixed"


def test_non_finite_losses_are_skipped_counted_and_finally_refused(tiny, tmp_path, short, monkeypatch):
    genuine = RAELoss.forward
    broken: set[int] = {1}
    calls = 0

    def forward(self, batch):
        nonlocal calls
        calls += 1
        value, parts = genuine(self, batch)
        return (value * math.nan if calls in broken or not broken else value), parts

    monkeypatch.setattr(RAELoss, "forward", forward)
    monkeypatch.setattr(loop, "MOST_SKIPPED_IN_A_ROW", 3)
    training = Training(task_for("rae", tiny, tmp_path / "one", "tiny", precision=FLOAT32))
    training.folder.mkdir(parents=True)
    steps = training.steps()
    next(steps)
    next(steps)
    assert training.skipped == 1 and training.skipped_in_a_row == 0
    assert all(torch.isfinite(p).all() for p in training.loss.parameters())
    # A finite loss with a gradient that is not is skipped too.
    before = [p.clone() for p in training.loss.parameters()]
    hook = next(training.loss.parameters()).register_hook(lambda gradient: gradient * math.nan)
    next(steps)
    hook.remove()
    assert training.skipped == 2
    assert all(torch.equal(p, q) for p, q in zip(before, training.loss.parameters(), strict=True))
    training.keep_best(math.nan)
    assert not (training.folder / "best.safetensors").exists()
    broken.clear()
    with pytest.raises(BadInput, match="not finite in 3 steps in a row"):
        train("rae", tiny, tmp_path / "all", precision=FLOAT32)


def test_missing_clips_are_named(tiny, tmp_path):
    copy = shutil.copytree(tiny, tmp_path / "copy")
    shutil.rmtree(copy / "val" / "cornell_box")
    with pytest.raises(BadInput, match="'val' are missing"):
        train("rae", copy, tmp_path)
    assert not (tmp_path / "train").exists()


def test_full_disk_is_one_clear_line_and_keeps_the_earlier_checkpoint(tiny, tmp_path, short):
    """A limit on file size stands in for a full disk."""
    training = Training(task_for("rae", tiny, tmp_path, "tiny", precision=FLOAT32))
    training.folder.mkdir(parents=True)
    training.save()
    checkpoint = training.folder / "checkpoint.pt"
    before = checkpoint.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, limits[1]))
        with pytest.raises(OSError, match="File too large"):
            training.save()
        with pytest.raises(OSError, match="File too large"):
            training.keep_best(0.5)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert checkpoint.read_bytes() == before
    assert not [path for path in training.folder.iterdir() if path.name.startswith(".") or "safetensors" in path.name]


def torchrun(processes: int, *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [*command, "-m", "onespp", "train", *arguments], env=environment, capture_output=True, text=True
    )


@pytest.mark.parametrize("name", ["wskp6", pytest.param("rae", marks=pytest.mark.slow)])
def test_two_processes_follow_the_loss_of_one(tiny, tmp_path, name):
    """The same global batch, shared: the losses of the first steps agree to rounding, and one of them writes."""
    common = ("--data", str(tiny), "--profile", "tiny", "--precision", FLOAT32)
    result = torchrun(2, name, "--runs", str(tmp_path / "two"), *common)
    assert result.returncode == 0, result.stderr[-2000:]
    assert result.stdout.count("trained") == 1
    one = train(name, tiny, tmp_path / "one", precision=FLOAT32)
    two = run_folder(tmp_path / "two", name, "tiny")
    curves = [[row["loss"] for row in read_metrics(folder / "metrics.csv")] for folder in (one.parent, two)]
    assert len(curves[0]) == len(curves[1])
    assert curves[1][:10] == pytest.approx(curves[0][:10], rel=1e-3)
    assert np.mean(curves[1][-10:]) == pytest.approx(np.mean(curves[0][-10:]), rel=0.1)
    assert tensors(two / "weights.safetensors").keys() == tensors(one).keys()


@pytest.mark.slow
def test_a_batch_that_cannot_be_shared_is_refused(tiny, tmp_path):
    result = torchrun(2, "ntd", "--runs", str(tmp_path), "--data", str(tiny), "--profile", "tiny")
    assert result.returncode != 0 and "a batch of 1 cannot be shared by 2 processes" in result.stderr
