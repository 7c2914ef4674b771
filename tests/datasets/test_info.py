"""The tables of `onespp info`."""

import math
import shutil

from datasets.channels import USUAL_CHANNELS
from datasets.clip import Dataset
from datasets.info import summarise


def test_info_lists_sizes_noise_floors_and_missing_clips(tiny_copy):
    shutil.rmtree(tiny_copy / "val" / "cornell_box" / "000")
    lines = summarise(tiny_copy).splitlines()
    for head in ("clip", "frames", "size", "noisy", "reference spp", "floor dB", "MB", "seconds"):
        assert head in lines[2]
    rows = {line.split()[0]: line.split()[1:] for line in reversed(lines) if line}  # the first of each name
    assert rows["val/cornell_box/000"] == ["missing"]
    clip = Dataset(tiny_copy).clips("test")[1]
    floor = f"{-10 * math.log10(clip.facts['floor_mse']):.1f}"
    assert rows["test/cornell_box_moving/000"][:5] == ["8", "64x64", "1", "128", floor.removesuffix(".0")]
    assert set(USUAL_CHANNELS) < set(rows)
    assert rows["roughness"][0] == "value" and rows["motion"][:2] == ["<f4,", "derived"]
    assert rows["dual_motion"][0] == "<f4"
