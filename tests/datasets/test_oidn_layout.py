"""Data sets for OIDN's training toolkit, read back by its rules."""

import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from datasets.card import CARD_FILE
from datasets.clip import Dataset
from datasets.oidn_layout import export_dataset
from errors import BadInput
from tests.helpers.datasets import digest

SAMPLES = re.compile(r"(.+)_(?:\d+|\d+spp|ref|reference|gt|target)", re.IGNORECASE)
FEATURES = ("hdr", "alb", "nrm")


def groups_of(folder: Path) -> dict[str, tuple[list[str], str]]:
    """Inputs and target of each group that the toolkit would take, trained with all features."""
    names: dict[str, set[str]] = defaultdict(set)
    for path in folder.rglob("*.*.exr"):
        name = path.name.rsplit(".", 2)[0]
        match = SAMPLES.fullmatch(name)
        names[match[1] if match else name].add(name)
    groups = {}
    for group, images in names.items():
        *inputs, target = sorted(images)
        wanted = [(name, feature) for name in inputs for feature in FEATURES] + [(target, "hdr")]
        if inputs and all((folder / f"{name}.{feature}.exr").is_file() for name, feature in wanted):
            groups[group] = (inputs, target)
    return groups


def read(folder: Path, name: str, feature: str) -> np.ndarray:
    """The image (H, W, 3) in the file's precision. The toolkit takes the first three channels, R, G and B first."""
    with OpenEXR.File(str(folder / f"{name}.{feature}.exr"), separate_channels=True) as file:
        planes = file.channels()
        assert set(planes) == set("RGB")
        return np.stack([planes[c].pixels for c in "RGB"], axis=-1)


@pytest.fixture(scope="module")
def exported(tiny, tmp_path_factory):
    out = tmp_path_factory.mktemp("oidn")
    return Dataset(tiny), out, export_dataset(tiny, out)


def test_every_realisation_of_every_frame_is_an_input_with_its_reference(exported):
    dataset, out, count = exported
    total = 0
    for split, folder in (("train", "train"), ("val", "valid"), ("test", "test")):
        groups = groups_of(out / folder)
        expected = {
            f"{clip.scene}-{clip.name}-{frame:04d}-{realisation}"
            for clip in dataset.clips(split)
            for frame in range(clip.frames)
            for realisation in range(clip.realisations)
        }
        assert groups.keys() == expected
        assert len(list((out / folder).iterdir())) == 6 * len(groups)
        for group, images in groups.items():
            assert images == ([f"{group}_0001spp"], f"{group}_reference")
        total += len(groups)
    assert count == total == 8 * (2 * 2 + 2 + 2)


def test_pixels_are_those_of_the_data_set_bit_for_bit(exported):
    dataset, out, _ = exported
    clip = dataset.clips("train")[1]
    folder = out / "train"
    [noisy], target = groups_of(folder)[f"{clip.scene}-{clip.name}-0005-1"]
    parts = [clip.read(name, 5, realisation=1).astype(np.float32) for name in ("emission", "direct", "indirect")]
    lights = (clip.read(name, 5).astype(np.float32) for name in ("emission", "direct_reference", "indirect_reference"))
    np.testing.assert_array_equal(read(folder, noisy, "hdr"), parts[0] + parts[1] + parts[2])
    np.testing.assert_allclose(read(folder, target, "hdr"), sum(lights).mean(axis=0), rtol=1e-6)
    for feature, channel in (("alb", "albedo"), ("nrm", "normal")):
        image = read(folder, noisy, feature)
        np.testing.assert_array_equal(image, read(folder, target, feature))
        assert image.dtype == np.float16 and image.tobytes() == np.ascontiguousarray(clip.read(channel, 5)).tobytes()
    assert read(folder, noisy, "hdr").dtype == read(folder, target, "hdr").dtype == np.float32


def test_more_samples_than_the_reference_has_are_inputs_too(tiny_copy, tmp_path):
    """The target is the last name in the order of text, in which 64spp comes after 1024spp."""
    path = tiny_copy / "val" / "cornell_box" / "000" / "clip.json"
    path.write_text(path.read_text().replace('"noisy_spp": 1,', '"noisy_spp": 20000,'))
    export_dataset(tiny_copy, tmp_path / "out")
    inputs, target = groups_of(tmp_path / "out" / "valid")["cornell_box-000-0003-0"]
    assert inputs == ["cornell_box-000-0003-0_20000spp"] and target.endswith("_reference")


def test_an_interrupted_export_is_resumed(exported, tiny, tmp_path, monkeypatch):
    _, whole, _ = exported
    out = tmp_path / "out"
    genuine = OpenEXR.File.write
    written = []

    def write(self, path):
        if len(written) == 50:
            raise KeyboardInterrupt
        written.append(path)
        return genuine(self, path)

    with monkeypatch.context() as patched:
        patched.setattr(OpenEXR.File, "write", write)
        with pytest.raises(KeyboardInterrupt):
            export_dataset(tiny, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.exr")}
    assert len(before) == 50
    export_dataset(tiny, out)
    assert {path: path.stat().st_mtime_ns for path in before} == before
    assert digest(out) == digest(whole)


def test_another_data_set_or_something_else_is_refused(exported, tiny_copy, tmp_path):
    _, out, _ = exported
    path = tiny_copy / "test" / "cornell_box" / "000" / "clip.json"
    path.write_text(path.read_text() + " ")
    assert (out / CARD_FILE).exists()
    with pytest.raises(BadInput, match="another data set"):
        export_dataset(tiny_copy, out)
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("precious")
    with pytest.raises(BadInput, match="something else"):
        export_dataset(tiny_copy, tmp_path / "thesis")
    path.unlink()
    with pytest.raises(BadInput, match="missing"):
        export_dataset(tiny_copy, tmp_path / "new")
    assert not (tmp_path / "new").exists()
