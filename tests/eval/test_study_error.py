"""The study of estimated errors."""

import numpy as np
import pytest

from errors import BadInput
from eval.studies import error
from eval.studies.error import ErrorComparison, in_band, study_error, table_of
from files import read_json
from render.clip import Sampling

TRUE = [1.0, 2.0, 4.0, 8.0]


def row(estimated: list[float], mapped: list[float]) -> ErrorComparison:
    return ErrorComparison("svgf+js", "room", 16, TRUE, estimated, mapped, 0.1, 0.1, 100.0)


def test_blocks_in_the_band_are_counted():
    compared = row([0.81, 1.59, 4.9, 10.1], [1.0, 2.0, 4.0, 0.0])
    assert in_band([compared], "estimated") == 0.5
    assert in_band([compared, compared], "mapped") == 0.75
    assert "50%" in table_of([compared]) and "75%" in table_of([compared])


def test_denoisers_without_error_estimate_are_refused(tmp_path):
    with pytest.raises(BadInput, match=r"svgf\+js does"):
        study_error(tmp_path, ("svgf",))


def test_with_many_samples_the_estimate_is_true(tmp_path, monkeypatch):
    monkeypatch.setattr(error, "CLIP_SCENES", ("cornell_box",))
    monkeypatch.setattr(error, "SHOWN", ("cornell_box", 16))
    monkeypatch.setattr(error, "LEVELS", (128, 64, 16))
    monkeypatch.setattr(error, "CLIP_SIZE", (2, 32, 32))
    monkeypatch.setattr(error, "BLOCK_PIXELS", 16)
    monkeypatch.setattr(error, "CLIP_SAMPLING", Sampling(realisations=16, noisy_spp=8, reference_spp=512))
    study_error(tmp_path, ("svgf+js",))
    folder = tmp_path / "study" / "error"
    assert (folder / "calibration.png").exists() and (folder / "map.png").exists()
    rows = read_json(folder / "results.json")["rows"]
    assert [row["spp"] for row in rows] == [128, 64, 16]
    for row in rows[:2]:
        assert np.sum(row["estimated"]) == pytest.approx(np.sum(row["true"]), rel=0.4)
    assert 64 < rows[0]["samples"] < 256
    true = [row["true_relative"] for row in rows]
    assert true == sorted(true)
