"""The bench of kernel fusion, in small."""

import json

import pytest

from errors import BadInput
from eval.bench.fusion import METHODS, UNFOLD, bench_fusion
from models.fusion import WINDOWS

FIELDS = [
    "method",
    "ms",
    "times faster",
    "peak MB",
    "share of memory",
    "largest relative difference",
]


def test_bench_fusion(tmp_path):
    table = bench_fusion(tmp_path, "48x32", threads=1, rounds=2, unfold_rounds=1)
    assert all(method in table for method in METHODS)
    results = json.loads((tmp_path / "bench" / "fusion.json").read_text())
    rows = results.pop("rows")
    assert results == {"device": "cpu", "threads": 1, "height": 32, "width": 48, "windows": [*WINDOWS]}
    assert [row["method"] for row in rows] == [*METHODS] and all([*row] == FIELDS for row in rows)
    unfold, *ours = rows
    assert unfold["method"] == UNFOLD and unfold["times faster"] == 1
    assert unfold["largest relative difference"] == 0
    for row in ours:
        assert row["times faster"] == pytest.approx(unfold["ms"] / row["ms"])
        assert 0 < row["largest relative difference"] < 1e-5  # the same image, in other sums
        if row["peak MB"] is not None:
            assert row["peak MB"] < 0.5 * unfold["peak MB"]
            assert row["share of memory"] == pytest.approx(row["peak MB"] / unfold["peak MB"])


def test_sizes_and_threads_that_cannot_be(tmp_path):
    with pytest.raises(BadInput, match="not a size"):
        bench_fusion(tmp_path, "720p")
    with pytest.raises(BadInput, match="at least 1"):
        bench_fusion(tmp_path, "48x32", threads=0)
