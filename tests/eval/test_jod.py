"""JOD from the pictures of an evaluation."""

import importlib
import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from errors import BadInput
from eval import jod
from eval.jod import FRAMES_PER_SECOND, jod_of_clip, jod_table
from eval.results import read_results
from files import read_json


class MeanDifference:
    """In place of the metric: 10 less the mean difference in 1/255."""

    def __init__(self):
        self.calls = []

    def predict(self, output, reference, dim_order, frames_per_second):
        assert output.shape == reference.shape and dim_order == "BCFHW"
        assert output.dtype == reference.dtype == torch.uint8 and output.max() > 127
        self.calls.append((tuple(output.shape), frames_per_second))
        return 10 - (output.float() - reference.float()).abs().mean(), {}

    def get_info_string(self):
        return "mean difference"


@pytest.fixture
def clip(evaluated):
    return read_results(evaluated)[1][0]


def with_two_references(clip):
    """The clip, of which only two frames were judged."""
    frames = [values if index in (0, 5) else {} for index, values in enumerate(clip.reference.frames)]
    return replace(clip, reference=replace(clip.reference, frames=frames))


def test_a_clip_is_one_video(evaluated, clip):
    metric = MeanDifference()
    values = jod_of_clip(metric, evaluated, clip)
    assert values.keys() == {result.denoiser for result in clip.results}
    assert metric.calls == [((1, 3, 8, 64, 64), FRAMES_PER_SECOND)] * len(values)
    assert values["noisy"] < values["accumulated"] < 10


def test_frames_between_which_references_are_missing_are_stills(evaluated, clip):
    metric = MeanDifference()
    values = jod_of_clip(metric, evaluated, with_two_references(clip))
    assert metric.calls == [((1, 3, 1, 64, 64), 0)] * 2 * len(values)


def test_the_table_and_the_file_say_how_each_clip_was_shown(evaluated, clip, tmp_path, monkeypatch):
    shutil.copytree(evaluated / "eval", tmp_path / "eval")
    clips = [replace(clip, scene="whole"), replace(with_two_references(clip), scene="some")]
    monkeypatch.setattr(jod, "read_results", lambda runs: ({}, clips))
    monkeypatch.setattr(jod, "jod_of_clip", lambda *_: {"noisy": 5.0})
    monkeypatch.setitem(sys.modules, "pycvvdp", SimpleNamespace(cvvdp=lambda **_: MeanDifference()))
    title, *lines = jod_table(tmp_path).splitlines()
    assert "Hz" not in title
    assert [line.split("  ")[1].strip() for line in lines[2:]] == ["at 24 Hz", "as stills"]
    assert read_json(tmp_path / "eval" / "jod.json")["frames_per_second"] == {"whole/000": 24, "some/000": None}


def test_a_clip_of_one_pixel_is_refused(evaluated, clip, monkeypatch):
    monkeypatch.setattr(jod, "video", lambda folder, frames: torch.zeros(1, 3, len(frames), 1, 1))
    with pytest.raises(BadInput, match="too small for JOD"):
        jod_of_clip(MeanDifference(), evaluated, clip)


def test_a_missing_package_names_its_extra(evaluated, monkeypatch):
    monkeypatch.setitem(sys.modules, "pycvvdp", None)
    with pytest.raises(BadInput, match=r"pycvvdp is not installed: `pip install 'onespp\[cvvdp\]'`"):
        jod_table(evaluated)


def can_import_metric() -> bool:
    try:
        importlib.import_module("pycvvdp")
    except (ImportError, RuntimeError):  # torchvision refuses to load beside a build of PyTorch for other devices
        return False
    return True


@pytest.mark.skipif(not can_import_metric(), reason="needs the extra cvvdp")
def test_by_colorvideovdp(evaluated, clip, tmp_path):
    shutil.copytree(evaluated / "eval", tmp_path / "eval")
    assert "standard_fhd" in jod_table(tmp_path)
    for values in read_json(tmp_path / "eval" / "jod.json")["clips"].values():
        assert 0 < values["noisy"] < values["accumulated"] < 10
    pycvvdp = importlib.import_module("pycvvdp")
    video = torch.rand(1, 3, 8, 64, 64)
    perfect = pycvvdp.cvvdp(display_name="standard_fhd", quiet=True).predict(video, video, frames_per_second=24)
    assert float(perfect[0]) == pytest.approx(10)
