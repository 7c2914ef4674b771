"""Lag after a light changes: all scenes end alike, and a denoiser without history has none."""

import numpy as np
import pytest

from eval.bench import light
from eval.bench.light import AFTER, BEFORE, CHANGE, STEADY, bench_light, changed
from files import read_json
from render.clip import Sampling
from tests.eval.conftest import untrained


def lamp(change: str, frame: int) -> np.ndarray:
    """Radiance and place of the lamp."""
    shape = changed(change).shapes[-1]
    assert shape.radiance is not None
    return np.concatenate([shape.radiance.at(frame), shape.motion.matrix(frame)[:3, 3]])


@pytest.mark.parametrize("change", BEFORE)
def test_all_scenes_end_in_the_same_light(change):
    for frame in range(CHANGE):
        assert np.allclose(lamp(change, frame), lamp(STEADY, frame)) == (change == STEADY)
    for frame in range(CHANGE, CHANGE + AFTER[-1] + 1):
        assert np.array_equal(lamp(change, frame), lamp(STEADY, frame))


def test_only_a_denoiser_with_history_lags(tmp_path, monkeypatch):
    changes = {change: BEFORE[change] for change in (STEADY, "switched-on")}
    monkeypatch.setattr(light, "BEFORE", changes)
    monkeypatch.setattr(light, "LIGHT_CLIP_SIZE", (light.LIGHT_CLIP_SIZE[0], 24, 32))
    monkeypatch.setattr(light, "LIGHT_CLIP_SAMPLING", Sampling(realisations=1, noisy_spp=1, reference_spp=8))
    untrained(tmp_path, "ntd")
    table = bench_light(tmp_path, ("noisy", "accumulated", "ntd@tiny"), "quick")
    assert "| ntd@tiny (indirect) |" in table
    assert "loss 8 frames after" in table and (tmp_path / "bench" / "light" / "plot.png").exists()
    rows = {row["denoiser"]: row["psnr"] for row in read_json(tmp_path / "bench" / "light" / "results.json")["rows"]}
    for change in changes:
        assert rows["noisy"][change][CHANGE:] == rows["noisy"][STEADY][CHANGE:]
        if change != STEADY:
            assert rows["accumulated"][change][CHANGE] < rows["accumulated"][STEADY][CHANGE] - 1
            assert rows["accumulated"][change][-1] < rows["accumulated"][STEADY][-1]
