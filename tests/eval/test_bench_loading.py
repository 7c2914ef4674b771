"""The bench of loading, in small."""

import json

import eval.bench.loading
from onespp import main


def test_bench_loading(tiny, tmp_path, monkeypatch, capsys):
    for name, value in {"WORKERS": (0,), "REPEATS": 1, "SEQUENCES": 8, "SIZES": (1e6, 10e6)}.items():
        monkeypatch.setattr(eval.bench.loading, name, value)
    main(["bench", "loading", "--data", str(tiny), "--runs", str(tmp_path), "--profile", "tiny"])
    assert "times training" in capsys.readouterr().out
    results = json.loads((tmp_path / "bench" / "loading.json").read_text())
    assert [row["what"] for row in results["speed"]] == ["loading, 0 workers", "training"]
    assert results["speed"][0]["to_training"] > 1
    small, big = results["memory"]
    assert small["data set GB"] >= 0.001 and big["data set GB"] >= 0.01 and big["clips"] > small["clips"]
    assert list((tmp_path / "bench").iterdir()) == [tmp_path / "bench" / "loading.json"]
