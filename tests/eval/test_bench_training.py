"""The bench of training steps, in small."""

import json

import pytest

import eval.bench.training
from onespp import main


def test_bench_training(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(eval.bench.training, "REPEATS", 1)
    main(["bench", "training", "rae", "--data", str(tiny), "--runs", str(tmp_path), "--profile", "tiny"])
    assert "times faster" in capsys.readouterr().out
    results = json.loads((tmp_path / "bench" / "training.json").read_text())
    (step,), (shares,) = results["steps"], results["shares"]
    assert step["float32 ms"] > 0 and step["bfloat16 ms"] > 0
    parts = [value for value in shares.values() if isinstance(value, float)]
    assert sum(parts) == pytest.approx(1)
    assert shares["convolutions"] > 0.1 and shares["loss"] > 0 and 0 < shares["loading"] < 0.5
