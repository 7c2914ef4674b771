"""What is noted of a training, and how the curve of its loss is smoothed."""

from contextlib import closing

import numpy as np

from train.log import Log, read_metrics
from train.pictures import smooth


def test_a_log_averages_and_forgets_what_a_kill_left(tmp_path):
    with closing(Log(tmp_path, done=0, total=6000)) as log:  # three steps a row
        for step in range(1, 8):
            log.step({"loss": float(step)})
            log.write(step, {"val_loss": 9.0} if step == 7 else None)
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
