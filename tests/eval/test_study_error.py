"""The bench of told errors: what it counts, and that it finds a true estimate true."""

import numpy as np
import pytest

from errors import BadInput
from eval.studies import error
from eval.studies.error import Told, in_band, study_error, table_of
from files import read_json
from render.clip import Sampling

TRUE = [1.0, 2.0, 4.0, 8.0]


def row(estimated: list[float], mapped: list[float]) -> Told:
    return Told("svgf+js", "room", 16, TRUE, estimated, mapped, 0.1, 0.1, 100.0)


def test_blocks_in_the_band_are_counted():
    told = row([0.81, 1.59, 4.9, 10.1], [1.0, 2.0, 4.0, 0.0])
    assert in_band([told], "estimated") == 0.5
    assert in_band([told, told], "mapped") == 0.75
    assert "50%" in table_of([told]) and "75%" in table_of([told])


def test_who_does_not_tell_its_error_is_refused(tmp_path):
    with pytest.raises(BadInput, match=r"svgf\+js does"):
        study_error(tmp_path, ("svgf",))


def test_of_many_samples_the_error_is_told_truly(tmp_path, monkeypatch):
    monkeypatch.setattr(error, "SCENES", ("cornell_box",))
    monkeypatch.setattr(error, "SHOWN", ("cornell_box", 16))
    monkeypatch.setattr(error, "LEVELS", (128, 64, 16))
    monkeypatch.setattr(error, "SIZE", (2, 32, 32))
    monkeypatch.setattr(error, "BLOCK", 16)
    monkeypatch.setattr(error, "SAMPLING", Sampling(realisations=16, noisy_spp=8, reference_spp=512))
    study_error(tmp_path, ("svgf+js",))
    folder = tmp_path / "study" / "error"
    assert (folder / "calibration.png").exists() and (folder / "map.png").exists()
    rows = read_json(folder / "results.json")["rows"]
    assert [told["spp"] for told in rows] == [128, 64, 16]
    for told in rows[:2]:
        assert np.sum(told["estimated"]) == pytest.approx(np.sum(told["true"]), rel=0.4)
    assert 64 < rows[0]["samples"] < 256
    true = [told["true_relative"] for told in rows]
    assert true == sorted(true)
