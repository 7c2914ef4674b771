"""Reading clips and data sets: what was rendered comes back, and what is missing or damaged is named."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from datasets.channels import CHANNELS, channels_of
from datasets.clip import Clip, Dataset
from datasets.frame import ChannelTensor, Frame
from datasets.info import find_problems, problems_of_clip
from errors import BadInput


def test_plan_and_layout(tiny):
    facts = json.loads((tiny / "dataset.json").read_text())
    assert facts["schema"] == 1 and facts["profile"] == "tiny" and facts["seed"] == 0
    assert facts["source"] == {} and facts["notes"] == []
    assert facts.keys() >= {"generator", "versions", "scenes", "options", "channels", "splits", "needed_spp"}
    for path in Dataset(tiny).planned():
        names = {file.name for file in path.iterdir()}
        assert {"clip.json", "timing.json", "direct.npy", "depth.npy"} <= names
        assert set(Clip(path).channels) == set(facts["channels"][path.parts[-3]])
        assert not any(name.endswith(".raw") for name in names)


def test_frames_have_an_attribute_for_every_image_channel():
    attributes = {name for name, value in vars(Frame).items() if isinstance(value, ChannelTensor)}
    of_layers = set(channels_of("mirrored", "second"))
    assert attributes == {name for name, channel in CHANNELS.items() if channel.is_image} - of_layers


def test_derived_motion_equals_rendered_motion(tiny):
    clip = Dataset(tiny).clips("test")[0]
    assert clip.scene == "cornell_box" and clip.channels["motion"] == {"derived": "camera"}
    assert clip.channels["roughness"] == {"value": [1.0]}
    equal = []  # share of the pixels of each frame
    largest = []  # motion in each frame, in pixels
    for index in range(1, clip.frames):
        # Both are the renderer's, and equal where nothing was disoccluded.
        motion = clip.read("motion", index)
        equal.append((motion == clip.read("dual_motion", index)).all(axis=-1).mean())
        largest.append(np.abs(motion).max())
        window = (slice(10, 20), slice(5, 60))
        np.testing.assert_array_equal(clip.read("motion", index, window), motion[window])
    assert np.mean(equal) > 0.9 and max(largest) > 0.5
    assert (clip.read("motion", 0) == 0).all() and (clip.read("dual_motion", 0) == 0).all()


def test_json_of_another_form_is_bad_input(tiny_copy):
    path = tiny_copy / "test" / "cornell_box" / "000"
    for content in ("[]", "3", '{"complete": true}'):
        (path / "clip.json").write_text(content)
        with pytest.raises(BadInput, match=r"clip.json is damaged"):
            Clip(path)
    (tiny_copy / "dataset.json").write_text("[]")
    with pytest.raises(BadInput, match=r"dataset.json is damaged"):
        Dataset(tiny_copy)


def test_missing_clip_and_other_schema(tiny_copy):
    shutil.rmtree(tiny_copy / "train" / "cornell_box" / "000")
    with pytest.raises(BadInput, match=r"train/cornell_box/000.*onespp dataset"):
        Dataset(tiny_copy).clips("train")
    facts = json.loads((tiny_copy / "dataset.json").read_text())
    (tiny_copy / "dataset.json").write_text(json.dumps(facts | {"schema": 99}))
    with pytest.raises(BadInput, match="schema version 99"):
        Dataset(tiny_copy)
    (tiny_copy / "dataset.json").write_text('{"schema": 1}')
    with pytest.raises(BadInput, match=r"dataset.json is damaged: it lacks .*splits"):
        Dataset(tiny_copy)


def test_splits_and_realisations_that_there_are_not(tiny):
    with pytest.raises(BadInput, match="has no split 'validation': use one of train, val, test"):
        Dataset(tiny).clips("validation")
    clip = Dataset(tiny).clips("test")[0]
    assert not clip.is_imported
    for number in (-1, clip.realisations):
        with pytest.raises(BadInput, match=f"realisations, numbered from 0: there is no {number}"):
            clip.read("direct", 0, realisation=number)


def test_more_memory_maps_than_files_may_be_open(tiny):
    """Every map holds a file descriptor, a dozen a clip, and the usual limit is 1024."""
    script = f"""
import resource
from pathlib import Path
from datasets.clip import Dataset
resource.setrlimit(resource.RLIMIT_NOFILE, (16, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
clips = Dataset(Path({str(tiny)!r})).clips("train")
maps = [clip.map(name) for clip in clips for name, entry in clip.channels.items() if "file" in entry]
assert len(maps) > 16, len(maps)
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_every_kind_of_damage_is_named(tiny_copy):
    assert find_problems(tiny_copy) == []
    clip = tiny_copy / "train" / "cornell_box" / "000"
    data = bytearray((clip / "depth.npy").read_bytes())
    data[len(data) // 2] ^= 1  # a single bit
    (clip / "depth.npy").write_bytes(data)
    (clip / "normal.npy").write_bytes((clip / "normal.npy").read_bytes()[:-100])
    (clip / "albedo.npy").unlink()
    np.save(clip / "mesh_id.npy", np.zeros((2, 2), np.uint16))
    (tiny_copy / "val" / "cornell_box" / "000" / "clip.json").write_text("{")
    shutil.rmtree(tiny_copy / "test" / "cornell_box" / "000")
    problems = find_problems(tiny_copy)
    for damaged in ("depth.npy", "normal.npy", "albedo.npy", "mesh_id.npy", "clip.json", "test/cornell_box/000"):
        assert any(damaged in problem for problem in problems)
    assert len(problems) == 6


def test_flipped_bits_in_a_header_are_found(tiny_copy):
    """Numpy reads the header of an .npy file as Python."""
    path = tiny_copy / "test" / "cornell_box" / "000"
    content = (path / "depth.npy").read_bytes()
    for bit in np.random.default_rng(0).integers(0, 128 * 8, 60):
        data = bytearray(content)
        data[bit // 8] ^= 1 << (bit % 8)
        (path / "depth.npy").write_bytes(data)
        assert any("depth.npy" in problem for problem in problems_of_clip(path))
