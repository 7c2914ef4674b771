"""The bench compares like with like."""

import json

import numpy as np
import pytest

import eval.bench.rendering
import eval.bench.time_to_floor
from eval.bench.rendering import bench_rendering
from eval.bench.time_to_floor import stock
from render.shot import Shot
from render.stage import Stage
from scenes.registry import build_scene


@pytest.mark.parametrize("name", ["cornell_box_moving", "extremes-large", "room-3"])
def test_both_renderers_see_the_same_frame(name):
    size, block = 48, 8
    shot = Shot(Stage(build_scene(name, 0, 24), size, size), 8)
    images = [
        render(1, 256).reshape(size // block, block, size // block, block, 3).mean(axis=(1, 3))
        for render in (stock(shot), shot.radiance)
    ]
    a, b = (np.minimum(image, np.percentile(image, 90)) for image in images)  # without the edges of lamps
    assert np.abs(a - b).mean() < 0.05 * a.mean()


def test_bench_of_references(tmp_path, monkeypatch):
    monkeypatch.setattr(eval.bench.rendering, "SCENES", ("cornell_box",))
    monkeypatch.setattr(eval.bench.time_to_floor, "SIZE", 24)
    table = bench_rendering(tmp_path)
    assert "onespp" in table and "stock path, independent" in table
    facts = json.loads((tmp_path / "bench" / "rendering.json").read_text())
    theirs, mine = facts["rows"]
    assert theirs["ratio"] == 1 and mine["ratio"] == pytest.approx(mine["seconds"] / theirs["seconds"])
    assert all(row["floor"] >= 40 or row["extrapolated"] for row in facts["rows"])
    assert mine["spp"] < theirs["spp"]  # stratified
    for row in facts["rows"]:
        seconds = row["seconds"] * 10 ** ((row["floor"] - 40) / 10)  # of the samples that were timed
        assert row["samples_per_second"] * seconds == pytest.approx(24 * 24 * row["spp"])
