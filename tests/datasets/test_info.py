"""The tables of `onespp info`, and measures of how difficult clips are."""

import math
import shutil

import numpy as np
import pytest
from matplotlib import pyplot as plt

from datasets.channels import USUAL_CHANNELS
from datasets.clip import Clip, Dataset
from datasets.info import BINS, MEASURES, Difficulty, difficulty_histograms, difficulty_of_clip, summarise
from datasets.writer import ClipWriter
from errors import BadInput
from plotting import DPI


def test_info_lists_sizes_noise_floors_and_missing_clips(tiny_copy):
    shutil.rmtree(tiny_copy / "val" / "cornell_box" / "000")
    lines = summarise(tiny_copy).splitlines()
    for head in ("clip", "frames", "size", "noisy", "reference spp", "floor dB", "P95/P5", "MB", "seconds"):
        assert head in lines[2]
    rows = {line.split()[0]: line.split()[1:] for line in reversed(lines) if line}  # the first of each name
    assert rows["val/cornell_box/000"] == ["missing"]
    clip = Dataset(tiny_copy).clips("test")[1]
    floor = f"{-10 * math.log10(clip.facts['floor_mse']):.1f}"
    assert rows["test/cornell_box_moving/000"][:5] == ["8", "64x64", "1", "128", floor.removesuffix(".0")]
    assert set(USUAL_CHANNELS) < set(rows)
    assert rows["roughness"][0] == "value" and rows["motion"][:2] == ["<f4,", "derived"]
    assert rows["dual_motion"][0] == "<f4"


def test_difficulty_by_hand(tmp_path):
    """Half of the pixels black at 1 spp, the others twice the reference of 1; one firefly; a dark tenth."""
    shape = (40, 50)
    reference = np.ones((*shape, 3))
    reference[:4] = 0.01  # a tenth of the rows
    noisy = 2 * reference
    noisy[:, ::2] = 0
    frame = {
        "direct": noisy[None] / 2,
        "indirect": np.zeros((1, *shape, 3)),
        "direct_reference": np.stack([reference, reference]) / 2,
        "indirect_reference": np.zeros((2, *shape, 3)),
        "emission": np.full((*shape, 3), 7.0),
        "albedo": np.full((*shape, 3), 0.5),
        "mesh_id": np.ones((*shape, 1)),
    }
    with ClipWriter(tmp_path / "clip") as writer:
        writer.add(frame, {})
        writer.finish({}, {})
    measured = difficulty_of_clip(Clip(tmp_path / "clip"))
    assert measured.zeros == pytest.approx(0.5)
    expected = (reference[..., 0] ** 2).mean() / reference[..., 0].mean() ** 2
    assert measured.relative_mse == pytest.approx(expected, rel=1e-3)
    assert measured.peak == pytest.approx(2 / noisy.mean(), rel=1e-3)
    assert measured.contrast == pytest.approx(100, rel=1e-2)


def test_histograms_count_every_clip_once():
    assert tuple(MEASURES) == Difficulty._fields
    clips = [Difficulty(0.0, 0.5, 3.0, math.inf), Difficulty(0.4, 0.5, 300.0, 9.0), Difficulty(*[math.nan] * 4)]
    figure = difficulty_histograms(clips)
    for axis, measure, counted in zip(figure.axes, MEASURES.values(), (2, 2, 2, 1), strict=True):
        heights = [bar.get_height() for bar in axis.patches]
        assert len(heights) == BINS and sum(heights) == counted
        assert axis.get_xlabel() == measure.title and axis.get_xscale() == "log"
    zeros = [bar.get_height() for bar in figure.axes[0].patches]
    assert zeros[0] == zeros[-1] == 1  # what is below the axis is shown at its end
    assert figure.axes[0].get_ylabel() == "clips of 3"
    plt.close(figure)


def test_histograms_are_written_as_a_picture(tiny, tiny_copy, tmp_path):
    summarise(tiny, tmp_path / "difficulty.png")
    picture = plt.imread(tmp_path / "difficulty.png")
    assert picture.shape[:2] == (2.6 * DPI, 12 * DPI)
    bars = (np.abs(picture[..., :3] - np.array([0x44, 0x77, 0xAA]) / 255).max(axis=-1) < 0.01).mean(axis=0)
    assert all(quarter.max() > 0.2 for quarter in np.array_split(bars, 4))  # bars in each of four histograms
    for path in Dataset(tiny_copy).planned():
        shutil.rmtree(path)
    with pytest.raises(BadInput, match="no clips yet"):
        summarise(tiny_copy, tmp_path / "none.png")
