"""OpenEXR files: lossless to the stored precision, readable without onespp, and clear about damage."""

import json

import numpy as np
import OpenEXR
import pytest

from datasets.channels import CHANNELS, USUAL_CHANNELS
from datasets.clip import Dataset
from datasets.exr import FACTS_ATTRIBUTE, channels_in, export_clip
from denoise.exr_image import ExrImage
from errors import BadInput


@pytest.fixture(scope="module")
def exported(tiny, tmp_path_factory):
    clip = Dataset(tiny).clips("test")[0]
    out = tmp_path_factory.mktemp("exr")
    assert export_clip(clip.path, out) == clip.frames
    return clip, out


def test_every_channel_comes_back_bit_for_bit(exported):
    clip, out = exported
    for index in (0, 5):
        image = ExrImage(out / f"{index:04d}.exr")
        channels = channels_in({name: plane.pixels for name, plane in image.channels.items()})
        facts = json.loads(image.header[FACTS_ATTRIBUTE])
        assert set(channels) == {name for name in USUAL_CHANNELS if CHANNELS[name].is_image}
        for name, array in channels.items():
            stored = clip.read(name, index)
            assert array.dtype == stored.dtype and array.tobytes() == np.ascontiguousarray(stored).tobytes()
        assert all(np.array_equal(facts[name], matrix) for name, matrix in clip.view(index)._asdict().items())
        assert facts["frame"] == index and facts["exposure"] == clip.exposure


def test_other_tools_find_the_usual_names(exported):
    clip, out = exported
    with OpenEXR.File(str(out / "0003.exr")) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
        header = dict(file.header())
    noisy = sum(clip.read(name, 3).astype(np.float32) for name in ("emission", "direct", "indirect"))
    np.testing.assert_array_equal(channels["RGB"], noisy)
    assert {"direct", "indirect", "albedo", "emission"} <= channels.keys()  # grouped as RGB layers by the reader
    assert {"normal.X", "normal.Y", "normal.Z", "depth.Z", "motion.X", "motion.Y"} <= channels.keys()
    assert header["compression"] == OpenEXR.ZIP_COMPRESSION
    view = clip.view(3)
    point = np.array([0.1, 0.2, 0.3, 1.0])
    expected = np.linalg.inv(view.camera_to_world) @ point
    np.testing.assert_allclose(point @ header["worldToCamera"], expected, atol=1e-5)
    assert json.loads(header["onespp"])["meshes"] == clip.facts["meshes"]


def test_frames_of_another_clip_are_not_mixed_in(exported, tmp_path):
    clip, _ = exported
    (tmp_path / "0049.exr").touch()
    with pytest.raises(BadInput, match=r"0049\.exr is no frame of"):
        export_clip(clip.path, tmp_path)


def test_damaged_files_are_named(exported, tmp_path):
    _, out = exported
    damaged = tmp_path / "damaged.exr"
    damaged.write_bytes((out / "0000.exr").read_bytes()[:2000])
    for path in (damaged, tmp_path / "missing.exr"):
        with pytest.raises(BadInput, match=path.name):
            ExrImage(path)
    assert not list(out.glob(".*"))
