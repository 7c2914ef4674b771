"""`onespp dataset --scene`: a user's own scene as a dataset like any other."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from command_line import main
from datasets.channels import USUAL_CHANNELS
from datasets.clip import Dataset
from errors import BadInput
from eval.tradeoff.samples import scene_of
from models.registry import channels_read
from render.clip import NO_OPTIONS
from render.job.generate import begun, portable
from render.job.profiles import SamplingQuality, own_profile, profile_of, source_of
from render.scene_file.load import TRACED, own_scene
from tests.helpers.datasets import digest
from tests.helpers.scene_files import old_xml, write, xml
from tests.test_cli import fails

SPLITS = """
[splits]
train = { clips = 1, realisations = 1, reference_spp = 4 }
val = { clips = 0 }
test = { clips = 2, reference_spp = 4, most_spp = 4 }
"""
CONTENT = old_xml('<shape type="cube" id="lost"><bsdf type="phong"/></shape>', '<emitter type="collimated"/>')


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A dataset of an old Mitsuba file. Read only."""
    root = tmp_path_factory.mktemp("own")
    own_scene.cache_clear()
    main(["dataset", "--scene", str(write(root, CONTENT, SPLITS)), "--data", str(root / "data"), "--reads", "wskp6"])
    return root


def test_it_is_a_data_set_like_any_other(made, capsys):
    dataset = Dataset(made / "data")
    assert len(dataset.clips("train")) == 1
    clip, _ = dataset.clips("test")
    assert (clip.height, clip.width, clip.frames) == (24, 32, 2)
    reference = clip.read("direct_reference", 1)
    assert np.isfinite(reference).all() and reference.max() > 0
    main(["verify", "--data", str(made / "data")])
    main(["info", "--data", str(made / "data")])
    out = capsys.readouterr().out
    assert "all files are intact" in out and "my" in out


def test_its_first_test_clip_begins_with_the_files_camera(made):
    clips = Dataset(made / "data").clips("test")
    expected = np.diag([-1.0, 1, -1, 1])
    expected[2, 3] = 5
    np.testing.assert_allclose(clips[0].view(0).camera_to_world, expected, atol=1e-6)
    assert np.abs(clips[1].view(0).camera_to_world - expected).max() > 0.01
    K = clips[0].view(0).K
    assert 16 / abs(K[0, 0]) == pytest.approx(np.tan(np.radians(20)), rel=1e-5)


def test_what_is_not_honoured_is_kept_with_the_data(made):
    facts = json.loads((made / "data" / "dataset.json").read_text())
    assert facts["profile"] == str(made / "my.toml")
    assert len(facts["notes"]) == 2 and "phong" in facts["notes"][0] and "collimated" in facts["notes"][1]
    assert set(facts["source"]) == {"my.toml", "scene.xml"}


def test_resuming_gives_the_same_bytes(made, tmp_path, capsys):
    copy = tmp_path / "copy"
    shutil.copytree(made / "data", copy)
    shutil.rmtree(copy / "test" / "my" / "001")
    main(["dataset", "--scene", str(made / "my.toml"), "--data", str(copy), "--reads", "wskp6"])
    captured = capsys.readouterr()
    assert "1 clips rendered" in captured.out and "phong" in captured.out + captured.err
    assert digest(copy) == digest(made / "data")


def test_a_moved_folder_is_resumed(made, tmp_path):
    moved = shutil.copytree(made, tmp_path / "moved")
    own_scene.cache_clear()
    dataset = begun(moved / "data", str(moved / "my.toml"), 0, channels_read(["wskp6"]), NO_OPTIONS)
    assert [shape.name for shape in scene_of(dataset.clips("test")[0], dataset)[0].meshes] == ["ball", "lost"]
    assert Dataset(moved / "data").facts["profile"] == str(moved / "my.toml")


def test_shares_of_light_are_not_compared():
    few, more = (["fog: left out", f"with 1 bounce only {share} {TRACED} arrives"] for share in (12, 13))
    assert portable("notes", few) == portable("notes", more) == ["fog: left out"]


def test_files_that_the_scene_file_names_are_part_of_its_source(tmp_path):
    mesh = '<shape type="obj"><string name="filename" value="a.obj"/></shape>'
    (tmp_path / "part.xml").write_text(f'<scene version="3.0.0">{mesh}</scene>')
    path = write(tmp_path, xml('<include filename="part.xml"/>'))
    found = []
    for corner in ("1 1 0", "1 1 0", "1 2 0"):
        (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv {corner}\nf 1 2 3\n")
        own_scene.cache_clear()
        found.append([*source_of(profile_of(str(path))).values()])
    assert found[0] == found[1] and found[0][0] == found[2][0] and found[0][1] != found[2][1]


@pytest.mark.parametrize("changed", ["my.toml", "scene.xml"])
def test_a_changed_file_is_another_scene(made, tmp_path, capsys, changed):
    copy = shutil.copytree(made, tmp_path / "copy")
    facts = (copy / "data" / "dataset.json").read_text().replace(str(made), str(copy))
    (copy / "data" / "dataset.json").write_text(facts)
    dataset = Dataset(copy / "data")
    clip = dataset.clips("test")[0]
    scene, _ = scene_of(clip, dataset)
    assert [shape.name for shape in scene.meshes] == ["ball", "lost"]
    with (copy / changed).open("a") as file:
        file.write("\n")
    with pytest.raises(BadInput, match="render it again"):
        scene_of(clip, dataset)
    words = ("--scene", str(copy / "my.toml"), "--data", str(copy / "data"), "--reads", "wskp6")
    assert "another source" in fails(capsys, "dataset", *words)


def test_refusals_leave_nothing_behind(tmp_path, capsys):
    def refused(*arguments: str) -> str:
        return fails(capsys, "dataset", "--data", str(tmp_path / "data"), "--scene", *arguments)

    assert "gone.toml cannot be read" in refused(str(tmp_path / "gone.toml"))
    toml = write(tmp_path, "", SPLITS)
    assert "scene.xml is empty or damaged" in refused(str(toml))
    (tmp_path / "scene.xml").unlink()
    assert "scene.xml cannot be read" in refused(str(toml))
    (tmp_path / "empty.ply").write_bytes(b"")
    mesh = '<shape type="ply"><string name="filename" value="empty.ply"/></shape>'
    assert "empty.ply" in refused(str(write(tmp_path, old_xml(mesh), SPLITS)))
    no_clips = "[splits]\ntrain.clips=0\nval.clips=0\ntest.clips=0"
    assert "no split has any clips" in refused(str(write(tmp_path, CONTENT, no_clips)))
    assert not (tmp_path / "data").exists()


def test_defaults_and_names(tmp_path):
    toml = write(tmp_path, CONTENT).rename(tmp_path / "größe 1.b.toml")
    profile = own_profile(toml)
    assert profile == profile_of(str(toml))
    assert profile.quality == {
        "train": SamplingQuality(realisations=4, reference_spp=128),
        "val": SamplingQuality(realisations=1, reference_spp=256),
        "test": SamplingQuality(realisations=1, reference_spp=256, floor=35, most_spp=2048),
    }
    assert {split: len(clips) for split, clips in profile.special.items()} == {"train": 4, "val": 1, "test": 1}
    assert profile.special["test"] == ["größe_1_b/000"]


def test_preview(made, tmp_path):
    main(["preview", str(made / "my.toml"), "--out", str(tmp_path / "sheet.png"), "--spp", "2"])
    assert (tmp_path / "sheet.png").stat().st_size > 1000


def test_a_texture_that_has_come_begins_another_dataset(tmp_path):
    """Frames rendered without it, and references of those, are not mixed with others."""
    picture = '<texture type="bitmap" name="reflectance"><string name="filename" value="wood.png"/></texture>'
    ball = f'<shape type="sphere" id="ball"><bsdf type="diffuse">{picture}</bsdf></shape>'
    described = (tmp_path / "data", str(write(tmp_path, xml(shape=ball), SPLITS)), 0, USUAL_CHANNELS, NO_OPTIONS)
    begun(*described)
    Image.new("RGB", (2, 2), "red").save(tmp_path / "wood.png")
    own_scene.cache_clear()  # as in another process
    with pytest.raises(BadInput, match="was made with another source"):
        begun(*described)
