"""The bench of training steps, in small."""

import json

import pytest

from eval.bench.training import bench_training
from timing import thread_count

PARTS = ["convolutions", "rest of the network", "loss", "Adam", "other", "loading"]


def test_bench_training(tiny, tmp_path):
    with thread_count(1):  # on images this small further threads only wait
        table = bench_training(tiny, tmp_path, "tiny", ["rae"], measured=1)
    assert "times faster" in table and "rest of the network" in table
    results = json.loads((tmp_path / "bench" / "training.json").read_text())
    assert [*results] == ["schema", "profile", "device", "steps", "shares"] and results["profile"] == "tiny"
    (step,) = results["steps"]
    (shares,) = results["shares"]
    assert [*step] == ["network", "float32 ms", "bfloat16 ms", "times faster"]
    assert step["float32 ms"] > 0 and step["bfloat16 ms"] > 0
    assert step["times faster"] == pytest.approx(step["float32 ms"] / step["bfloat16 ms"])
    assert [*shares] == ["network", "precision", *PARTS]
    assert shares["precision"] == ("bfloat16" if step["times faster"] > 1 else "float32")
    assert sum(shares[part] for part in PARTS) == pytest.approx(1)
    assert shares["convolutions"] > 0.1 and shares["loss"] > 0 and 0 < shares["loading"] < 0.5
