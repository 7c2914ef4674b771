"""The bench of loading, in small."""

import json
from pathlib import Path

import pytest

from eval.bench.loading import bench_loading
from timing import thread_count


def test_bench_loading(tiny, tmp_path):
    with thread_count(1):  # on images this small further threads only wait
        table = bench_loading(tiny, tmp_path, "tiny", workers=[0], measured=1, sequences=8, sizes=[1e6, 10e6])
    assert "times training" in table
    results = json.loads((tmp_path / "bench" / "loading.json").read_text())
    assert [*results] == ["profile", "training", "speed", "memory"]
    assert results["profile"] == "tiny" and results["training"].startswith("rae, ")
    loading, training = results["speed"]
    assert [*loading] == [*training] == ["what", "sequences_s", "megapixels_s", "to_training"]
    assert [loading["what"], training["what"]] == ["loading, 0 workers", "training"]
    assert loading["to_training"] > 1 and training["to_training"] == 1
    assert loading["to_training"] == pytest.approx(loading["sequences_s"] / training["sequences_s"])
    pixels = {row["megapixels_s"] / row["sequences_s"] for row in results["speed"]}
    assert max(pixels) == pytest.approx(min(pixels))
    small, big = results["memory"]
    assert [*small] == [*big] == ["data set GB", "clips", "RssAnon MB before", "after an epoch"]
    assert small["data set GB"] >= 0.001 and big["data set GB"] >= 0.01 and big["clips"] > small["clips"]
    if Path("/proc/self/status").exists():
        assert all(row["RssAnon MB before"] > 0 and row["after an epoch"] > 0 for row in results["memory"])
    assert list((tmp_path / "bench").iterdir()) == [tmp_path / "bench" / "loading.json"]  # no copies are left
