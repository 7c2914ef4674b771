"""The bench of training steps, in small."""

import json

import pytest

from eval.bench.training import bench_training

PARTS = ["convolutions", "rest of the network", "loss", "Adam", "other", "loading"]


def test_bench_training(tiny, tmp_path):
    table = bench_training(tiny, tmp_path, "tiny", ["rae"], measured=1)
    assert "times faster" in table and "rest of the network" in table
    results = json.loads((tmp_path / "bench" / "training.json").read_text())
    assert [*results] == ["schema", "profile", "device", "steps", "shares"] and results["profile"] == "tiny"
    (step,), (shares,) = results["steps"], results["shares"]
    assert [*step] == ["network", "32-true ms", "bf16-mixed ms", "times faster"]
    assert step["32-true ms"] > 0 and step["bf16-mixed ms"] > 0
    assert step["times faster"] == pytest.approx(step["32-true ms"] / step["bf16-mixed ms"])
    assert [*shares] == ["network", "precision", *PARTS]
    assert shares["precision"] == ("bf16-mixed" if step["times faster"] > 1 else "32-true")
    assert sum(shares[part] for part in PARTS) == pytest.approx(1)
    assert shares["convolutions"] > 0.1 and shares["loss"] > 0 and 0 < shares["loading"] < 0.5
