"""The loop: it resumes to the same bits, trains alone in its folder, and shows what it does."""

import csv
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from itertools import islice
from queue import Queue
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from errors import BadInput
from files import locked
from tests.helpers.training import as_command, folder_of, metadata, same_weights, short_task, start_training, tensors
from timing import thread_count
from train.log import METRICS_CSV, Log, read_metrics, smooth
from train.loop import alone_in, train_network
from train.precision import BFLOAT16, FLOAT32
from train.task import WEIGHTS_FILE
from train.training import BEST_FILE, CHECKPOINT_FILE, Training

# --- Interrupted, killed and finished ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["wskp6", *(pytest.param(name, marks=pytest.mark.slow) for name in ("rae", "ntd"))])
def test_interrupted_training_resumes_to_equal_weights(tiny, tmp_path, monkeypatch, name):
    """Interrupted in the middle of an epoch; the weights equal those of an undisturbed run bit for bit."""
    recipe = {"epochs": 2, "crops": (2, 1)} if name == "wskp6" else {"epochs": 4}
    recipe["average"] = 0.5
    whole = train_network(short_task(name, tiny, tmp_path / "whole", **recipe)).parent
    task = short_task(name, tiny, tmp_path / "resumed", **recipe)
    genuine = Training.steps

    def steps(self: Training) -> Iterator[dict[str, float]]:
        yield from islice(genuine(self), 5)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Training, "steps", steps)
        with pytest.raises(KeyboardInterrupt):
            train_network(task, save_seconds=0.0)
    assert not (task.folder / WEIGHTS_FILE).exists()
    train_network(task)
    assert same_weights(whole, task.folder)
    rows = [read_metrics(folder / METRICS_CSV) for folder in (whole, task.folder)]
    assert [r["loss"] for r in rows[0]] == [r["loss"] for r in rows[1]]
    assert [r["step"] for r in rows[0]] == list(range(1, len(rows[0]) + 1)) and len(rows[0]) > 6


def test_a_training_from_before_recipes_got_a_number_has_its_default(tiny, tmp_path, trained_copy):
    saved = torch.load(trained_copy / CHECKPOINT_FILE)
    del saved["facts"]["warm_up"], saved["facts"]["loss"]["name"], saved["facts"]["data"]["clips"]
    torch.save(saved, trained_copy / CHECKPOINT_FILE)
    assert train_network(short_task("rae", tiny, tmp_path, precision=None)) == trained_copy / WEIGHTS_FILE
    with pytest.raises(BadInput, match="another recipe, seed, data set or start"):
        train_network(short_task("rae", tiny, tmp_path, precision=None, warm_up=1.0))
    saved["facts"]["loss"]["name"] = "AnotherLoss"  # of the same numbers
    torch.save(saved, trained_copy / CHECKPOINT_FILE)
    with pytest.raises(BadInput, match="another recipe, seed, data set or start"):
        train_network(short_task("rae", tiny, tmp_path, precision=None))


def test_a_finished_training_is_left_alone_and_another_refused(tiny, tiny_copy, tmp_path, trained_copy):
    weights = trained_copy / WEIGHTS_FILE
    before = {path: path.stat().st_mtime_ns for path in trained_copy.iterdir()}
    task = short_task("rae", tiny, tmp_path, precision=None)
    assert train_network(replace(task, usual_precision=BFLOAT16)) == weights
    assert {path: path.stat().st_mtime_ns for path in trained_copy.iterdir()} == before
    with pytest.raises(BadInput, match="another recipe, seed, data set or start"):
        train_network(short_task("rae", tiny, tmp_path, seed=1, precision=None))
    clip = next(tiny_copy.glob("val/*/*/clip.json"))
    clip.write_text(clip.read_text() + "\n")  # of other content, as a scene of one's own that was changed
    with pytest.raises(BadInput, match="another recipe, seed, data set or start"):
        train_network(short_task("rae", tiny_copy, tmp_path, precision=None))
    with pytest.raises(BadInput, match="a training in float32"):
        train_network(short_task("rae", tiny, tmp_path, precision=BFLOAT16))
    weights.unlink()
    with pytest.raises(BadInput, match="no weights"):
        train_network(task)
    checkpoint = trained_copy / CHECKPOINT_FILE
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(BadInput, match=r"checkpoint.pt is damaged"):
        train_network(task)


@pytest.mark.slow
def test_a_training_in_bfloat16_keeps_its_weights_in_float32(tiny, tmp_path):
    recipe = {"epochs": 1, "crops": (1, 1)}
    weights = train_network(short_task("wskp3", tiny, tmp_path, precision=BFLOAT16, **recipe))
    assert all(tensor.dtype == torch.float32 and tensor.isfinite().all() for tensor in tensors(weights).values())
    assert train_network(short_task("wskp3", tiny, tmp_path, precision=None, **recipe)) == weights
    with pytest.raises(BadInput, match="a training in bfloat16"):
        train_network(short_task("wskp3", tiny, tmp_path, precision=FLOAT32, **recipe))


@pytest.mark.slow
@pytest.mark.parametrize("name, epochs", [("rae", 15), ("wskp6", 2), ("ntd", 3)])
def test_killed_training_ends_with_the_weights_of_an_undisturbed_one(tiny, tmp_path, name, epochs):
    """Begun and killed in processes of their own, ended in this one, where the undisturbed one runs as well."""
    recipe = {"epochs": epochs}
    metrics = folder_of(tmp_path / "killed", name) / METRICS_CSV
    kills = 0
    for row in range(3, 24, 2):  # of the log, once the training has written it
        process = start_training(name, tiny, tmp_path / "killed", **recipe)
        while process.poll() is None and (not metrics.exists() or metrics.read_text().count("\n") < row):
            time.sleep(0.002)
        process.kill()
        kills += process.wait() == -signal.SIGKILL
    assert kills
    killed = train_network(short_task(name, tiny, tmp_path / "killed", **recipe)).parent
    whole = train_network(short_task(name, tiny, tmp_path / "whole", **recipe)).parent
    assert same_weights(whole, killed)
    assert not [path for path in killed.iterdir() if path.suffix == ".tmp"]


# --- Alone in a folder ------------------------------------------------------------------------------------------------


def test_what_a_killed_training_has_half_written_is_removed(tiny, tmp_path, trained_copy):
    half_written = trained_copy / f".{BEST_FILE}.1.tmp"
    half_written.write_bytes(b"half")
    train_network(short_task("rae", tiny, tmp_path, precision=None))
    assert not half_written.exists()


def test_the_checkpoint_of_a_training_at_work_is_not_read(tiny, tmp_path, trained_copy):
    """It may be half of one training and half of another; here it is damaged, which only a reader would notice."""
    (trained_copy / CHECKPOINT_FILE).write_bytes(b"being written")
    task = short_task("rae", tiny, tmp_path, precision=None)
    with locked(trained_copy / ".lock") as ours:
        assert ours
        with pytest.raises(BadInput, match="another process is training in"):
            train_network(task)
    with pytest.raises(BadInput, match=r"checkpoint.pt is damaged"):
        train_network(task)
    assert not (trained_copy / ".lock").exists()


def two_processes() -> tuple[SimpleNamespace, SimpleNamespace]:
    """Stand-ins for Fabric in two processes, which are threads here."""
    sent: Queue[bool] = Queue()

    def send(value: bool) -> bool:
        sent.put(value)
        return value

    first = SimpleNamespace(is_global_zero=True, broadcast=send)
    second = SimpleNamespace(is_global_zero=False, broadcast=lambda _: sent.get(timeout=60))
    return first, second


def test_the_first_process_locks_and_the_others_wait_for_it(tmp_path):
    first, second = two_processes()
    entered = threading.Event()
    leave = threading.Event()

    def work() -> None:
        with alone_in(tmp_path, second):
            entered.set()
            assert leave.wait(timeout=60)

    with ThreadPoolExecutor(1) as thread:
        other = thread.submit(work)
        assert not entered.wait(timeout=0.1)
        with alone_in(tmp_path, first):
            assert entered.wait(timeout=60)
            with locked(tmp_path / ".lock") as ours:
                assert not ours
        with locked(tmp_path / ".lock") as ours:  # the second process, which is still at work, holds none
            assert ours
        leave.set()
        other.result()


def test_where_another_training_has_the_lock_all_processes_are_refused(tmp_path):
    first, second = two_processes()
    with locked(tmp_path / ".lock"):
        for fabric in (first, second):
            with pytest.raises(BadInput, match="another process is training in"), alone_in(tmp_path, fabric):
                pytest.fail("entered")


# --- What it leaves -----------------------------------------------------------------------------------------------


def test_training_shows_what_it_does(trained_runs):
    folder = folder_of(trained_runs, "rae")
    weights = folder / WEIGHTS_FILE
    facts = metadata(weights)
    assert facts["denoiser"] == "rae" and '"epochs": 1' in facts["recipe"] and '"crop": 32' in facts["recipe"]
    assert all(t.dtype == torch.float32 and torch.isfinite(t).all() for t in tensors(weights).values())
    assert list(folder.glob("events.out.tfevents.*"))
    with (folder / METRICS_CSV).open() as file:
        rows = list(csv.DictReader(file))
    columns = "step learning_rate loss spatial gradient temporal gradient_norm skipped step_ms loading_ms val_loss"
    assert set(rows[0]) == set(columns.split())
    assert rows[-1]["val_loss"]
    assert imread(folder / "sample.png").shape[:2] == (64, 4 * 64)
    assert imread(folder / "loss.png").ndim == 3
    assert not (folder / ".lock").exists()


def test_a_log_averages_and_forgets_what_a_kill_left(tmp_path):
    with closing(Log(tmp_path, done=0, total=6000)) as log:  # three steps a row
        for step in range(1, 8):
            log.add(step, {"loss": float(step)}, 9.0 if step == 7 else None)
    assert [(r["step"], r["loss"]) for r in read_metrics(log.path)] == [(3, 2.0), (6, 5.0), (7, 7.0)]
    assert read_metrics(log.path)[-1]["val_loss"] == 9.0
    with log.path.open("a") as file:
        file.write("9,8.0")  # cut off
    with closing(Log(tmp_path, done=6, total=6000)) as resumed:
        assert [r["step"] for r in read_metrics(resumed.path)] == [3, 6]


def test_a_curve_is_smoothed_to_means_of_neighbours():
    points = np.stack([np.arange(1001), np.arange(1001) % 5], axis=1).astype(float)
    smoothed = smooth(points)
    assert smoothed.shape == (200, 2)
    assert smoothed[:2].tolist() == [[2, 2], [7, 2]]


# --- In several processes ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name, recipe", [("wskp6", {"epochs": 1, "crops": (10, 1)}), ("rae", {"epochs": 15})])
def test_two_processes_follow_the_loss_of_one(tiny, tmp_path, name, recipe):
    """The same global batch, shared: the losses of the first steps agree to rounding, and one of them writes.

    Each process computes with one thread, for the number of threads decides in which order is summed. And only the
    first steps are compared one by one: where a gradient is zero but for rounding, its sign is chance, and Adam makes
    a whole step of it. The curves of equal trainings so part by a factor of two to ten in every step.
    """
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += as_command(name, tiny, tmp_path / "two", **recipe)
    result = subprocess.run(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr[-2000:]
    assert result.stdout.count("trained") == 1
    two = folder_of(tmp_path / "two", name)
    with thread_count(1):
        one = train_network(short_task(name, tiny, tmp_path / "one", **recipe)).parent
    curves = [[row["loss"] for row in read_metrics(folder / METRICS_CSV)] for folder in (one, two)]
    assert len(curves[0]) == len(curves[1])
    assert curves[1][:3] == pytest.approx(curves[0][:3], rel=1e-4)
    assert curves[1][3:5] == pytest.approx(curves[0][3:5], rel=1e-3)
    assert np.mean(curves[1][-10:]) == pytest.approx(np.mean(curves[0][-10:]), rel=0.1)
    assert tensors(two / WEIGHTS_FILE).keys() == tensors(one / WEIGHTS_FILE).keys()
