"""The bench of rendering compares like with like."""

import json

import numpy as np
import pytest

from errors import BadInput
from eval.bench.rendering import MAX_SPP, bench_rendering
from eval.bench.stock import stock_render
from render.path import PosedFrame
from render.stage import Stage
from scenes.registry import build_scene

FIELDS = ["scene", "renderer", "spp", "samples_per_second", "floor", "seconds", "extrapolated", "ratio"]


@pytest.mark.parametrize("name", ["cornell_box_moving", "extremes-large", "room-2"])
def test_both_renderers_render_the_same_frame(name):
    size = 48
    block = 8
    posed = PosedFrame(Stage(build_scene(name, 0, 24), size, size), 8)
    images = [
        render(1, 128).reshape(size // block, block, size // block, block, 3).mean(axis=(1, 3))
        for render in (stock_render(posed), posed.radiance)
    ]
    a, b = (np.minimum(image, np.percentile(image, 90)) for image in images)  # without the edges of lamps
    assert np.abs(a - b).mean() < 0.05 * a.mean()


def test_bench_of_references(tmp_path):
    table = bench_rendering(tmp_path, ["cornell_box"], size=24)
    assert "onespp" in table and "stock path, independent" in table
    facts = json.loads((tmp_path / "bench" / "rendering.json").read_text())
    assert [*facts] == ["variant", "size", "frame", "target_db", "rows"] and facts["size"] == 24
    theirs, ours = facts["rows"]
    assert [*theirs] == [*ours] == FIELDS
    assert theirs["ratio"] == 1 and ours["ratio"] == pytest.approx(ours["seconds"] / theirs["seconds"])
    for row in facts["rows"]:
        assert row["extrapolated"] == (row["floor"] < 40)
        assert not row["extrapolated"] or row["spp"] == MAX_SPP
    assert ours["spp"] < theirs["spp"]  # stratified
    for row in facts["rows"]:
        seconds = row["seconds"] * 10 ** ((row["floor"] - 40) / 10)  # of the samples that were timed
        assert row["samples_per_second"] * seconds == pytest.approx(24 * 24 * row["spp"])


def test_scenes_to_render_can_be_named(tmp_path):
    with pytest.raises(BadInput, match="unknown scene 'castle'"):
        bench_rendering(tmp_path, ["castle"])
    assert not (tmp_path / "bench").exists()
