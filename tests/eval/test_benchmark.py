"""The benchmark: scenes that are there are rendered and evaluated; published rules; the page for people."""

import math
import zlib

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from datasets.clip import Dataset
from datasets.imported import ImportedFrame, write_dataset
from errors import BadInput
from eval.benchmark.page import write_page
from eval.benchmark.published import aces_tone, published
from eval.benchmark.run import OWN_FORMAT, Format, entries, list_scenes, located, run, toml_of
from files import read_json
from models.filters.oidn import OIDN
from models.registry import prototype
from provenance import ROOT
from render.job.profiles import BENCHMARK_SCENES, JUDGED
from render.scene_file.description import read_description
from scenes.camera import STILL, View, intrinsics, look_at
from tests.eval.conftest import untrained
from tests.helpers.scene_files import xml

NAMES = ("noisy", "svgf", "one")


@pytest.fixture(scope="module")
def benchmark(tmp_path_factory):
    """Two of the scenes, rendered small and evaluated; the folder, and the file of results."""
    root = tmp_path_factory.mktemp("benchmark")
    for name in ("kitchen", "bedroom"):
        (root / "scenes" / name).mkdir(parents=True)
        (root / "scenes" / name / "scene.xml").write_text(xml())
    return root, run(root / "scenes", root / "data", root / "runs", NAMES, Format((24, 24), 6, 35.0), own=False)


def test_scenes_that_are_there_are_evaluated_and_the_others_named(benchmark):
    root, path = benchmark
    content = read_json(path)
    assert {row["scene"] for row in content["rows"]} == {"kitchen", "bedroom"}
    clip = Dataset(root / "data" / "kitchen").clips("test")[0]
    assert clip.judged == [0, 4]
    assert content["digests"]["kitchen"]["clip"] == clip.fingerprint
    assert content["digests"]["kitchen"]["crc32"] == f"{zlib.crc32(xml().encode()):08x}"
    assert content["digests"]["kitchen"]["files"] == content["digests"]["bedroom"]["files"]
    assert content["by_age"]["psnr"]["svgf"]["fifth"] > content["by_age"]["psnr"]["noisy"]["fifth"]
    assert [row["scene"] for row in content["rendered"]] == ["bedroom", "kitchen"]
    assert all(row["judged"] == 2 and row["seconds"] > 0 for row in content["rendered"])
    assert content["where"]["kitchen"].keys() == {"pixels", "one"}
    assert sum(content["where"]["kitchen"]["one"]["place"].values()) == pytest.approx(1)
    listed = list_scenes(root / "scenes")
    assert listed.count("missing") == len(entries()) - 2 and "Jay-Artist" in listed


def test_digests_tell_our_scene_files_from_others(tmp_path, monkeypatch):
    """In folders whose names have `_` for `-` as well."""
    for name in ("kitchen", "glass_of_water", "veach-ajar"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "scene.xml").write_text(xml())
    crc32 = f"{zlib.crc32(xml().encode()):08x}"
    described = entries()
    described["veach-ajar"]["crc32"] = crc32
    monkeypatch.setattr("eval.benchmark.run.entries", lambda: described)
    there = {line.split()[0]: line for line in list_scenes(tmp_path).splitlines()[2:16]}
    assert there["kitchen"].endswith(" yes") and there["bathroom"].endswith(" missing")
    assert there["veach-ajar"].endswith("the scene.xml of our results")
    assert there["glass-of-water"].endswith(f"another scene.xml than that of our results ({crc32})")


def test_our_own_scenes_are_listed_with_their_commands():
    listed = list_scenes(None)
    assert all(name in listed for name in BENCHMARK_SCENES) and "--own" in listed and "--profile glass" in listed
    assert "`make blender`" in listed and (ROOT / "tests/blender/render_room.py").exists()


def test_the_toml_of_a_scene_can_be_printed(tmp_path):
    """It describes what the command renders: beside the folder of the scene it can be used as it is."""
    (tmp_path / "my.toml").write_text(toml_of("veach-ajar"))
    described = read_description(tmp_path / "my.toml")
    assert described.file == "veach-ajar/scene.xml" and described.bounces == 8
    assert (described.resolution, described.frames) == ((640, 360), 49) and described.splits.test.judged == JUDGED
    with pytest.raises(BadInput, match="'cellar' is not one of the scenes: bathroom"):
        toml_of("cellar")


def test_clips_of_our_own_have_one_format(tmp_path):
    with pytest.raises(BadInput, match="640x360, 49 frames, to 35 dB: leave out --size"):
        run(None, tmp_path / "data", tmp_path / "runs", NAMES, OWN_FORMAT._replace(floor=30.0), own=True)
    assert not any(tmp_path.iterdir())


def test_denoisers_are_checked_before_anything_is_rendered(benchmark, tmp_path, capsys, monkeypatch):
    """A mistyped one is refused; of those that run by default, one that is not installed is left out with a note."""
    root, _ = benchmark
    rendered = tmp_path / "data", tmp_path / "runs"
    with pytest.raises(BadInput, match="unknown denoiser 'odin'"):
        run(root / "scenes", *rendered, ("odin",), Format((24, 24), 6, 35.0), own=False)
    monkeypatch.setattr(OIDN, "unavailable", lambda self: "pyoidn is not installed")
    prototype.cache_clear()
    with pytest.raises(BadInput, match="oidn: pyoidn is not installed"):
        run(root / "scenes", *rendered, ("oidn",), Format((24, 24), 6, 35.0), own=False)
    assert not any(tmp_path.iterdir())
    monkeypatch.setattr("eval.benchmark.run.NAMES", ("noisy", "oidn+accumulated"))
    content = read_json(
        run(root / "scenes", root / "data", tmp_path / "runs", (), Format((24, 24), 6, 35.0), own=False)
    )
    assert {row["denoiser"] for row in content["rows"]} == {"noisy"}
    assert "oidn+accumulated: skipped, pyoidn is not installed" in capsys.readouterr().out


def test_a_network_of_indirect_light_alone_has_no_means_of_total_light(benchmark, tmp_path):
    root, _ = benchmark
    content = read_json(
        run(root / "scenes", root / "data", tmp_path / "runs", ("ntd",), Format((24, 24), 6, 35.0), own=False)
    )
    assert {row["denoiser"] for row in content["rows"]} == {"ntd"} and not any(content["by_age"].values())


def test_without_names_no_errors_are_located(benchmark):
    """Elsewhere no names stand for all denoisers."""
    root, _ = benchmark
    assert located(Dataset(root / "data" / "kitchen").clips("test")[0], [], root / "runs") == {}


def test_a_folder_without_any_of_the_scenes_is_refused(tmp_path):
    with pytest.raises(BadInput, match="none of the scenes"):
        run(tmp_path, tmp_path / "data", tmp_path / "runs", NAMES, Format((24, 24), 2, 35.0), own=False)


def test_the_page_has_both_videos_of_every_clip(benchmark):
    root, _ = benchmark
    page = write_page(NAMES[:2], [root / "data" / "kitchen"], root / "runs", "quick").read_text()
    assert page.count("data:image/webp;base64,") == 2 * 6 and "kitchen/000" in page
    with pytest.raises(BadInput, match="noisy is named twice"):
        write_page(("noisy", "noisy"), [root / "data" / "kitchen"], root / "runs", "quick")
    untrained(root / "runs", "ntd")
    with pytest.raises(BadInput, match="noisy total and ntd@tiny indirect light are different images"):
        write_page(("noisy", "ntd@tiny"), [root / "data" / "kitchen"], root / "runs", "quick")


SIZE = 24, 32


def frames(count):
    view = View(intrinsics(60.0, *SIZE), look_at(np.zeros(3), np.array([0.0, 0, -1])), STILL)
    for index in range(count):
        rng = np.random.default_rng(index)
        light, reference = rng.exponential(0.3, (2, *SIZE, 3)).astype("f4")
        ones = np.ones((*SIZE, 3), "f4")
        position = np.broadcast_to(np.float32([0, 0, -2]), (*SIZE, 3))
        yield ImportedFrame(light, reference, ones, ones, position, np.ones(SIZE, bool), view)


def test_published_rules_are_those_of_the_scripts(tmp_path):
    """PSNR and SSIM of `noisy` by numpy and scikit-image, from 8-bit images; the first 16 frames do not count."""
    write_dataset(tmp_path / "data", "noisebase at 2 spp", {"bistro1": frames(19)}, 2)
    lines = published(["noisy"], tmp_path / "data", tmp_path, "quick").splitlines()
    row = next(line.split() for line in lines if line.startswith("noisy"))
    assert any(line.startswith("NPPD") and "28.4" in line for line in lines)
    assert "FVVDP, which is not computed here: 7.36" in lines[-1]
    assert lines[0].split("  ")[-1].strip() == "tPSNR" and "made from" in lines[0]
    row.remove("ours")

    def stored(image):
        toned = aces_tone(torch.from_numpy(image).double().movedim(-1, 0)[None])[0].movedim(0, -1).numpy()
        return (255 * toned.astype(np.float64)).astype(np.uint8).astype(np.float64) / 255

    pairs = [(stored(frame.radiance), stored(frame.reference)) for frame in frames(19)][16:]
    psnrs = [-10 * math.log10(((x - y) ** 2).mean()) for x, y in pairs]
    assert float(row[1]) == pytest.approx(np.mean(psnrs), abs=0.02)
    weights = np.array([0.2126, 0.7152, 0.0722])
    keys = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "win_size": 11, "data_range": 1}
    maps = [structural_similarity(x**2.2 @ weights, y**2.2 @ weights, full=True, **keys)[1] for x, y in pairs]
    assert float(row[2]) == pytest.approx(np.mean([each[5:-5, 5:-5].mean() for each in maps]), abs=2e-3)
    changes = [(pairs[i + 1][0] - pairs[i][0]) - (pairs[i + 1][1] - pairs[i][1]) for i in range(2)]
    assert float(row[4]) == pytest.approx(np.mean([-10 * math.log10((c**2).mean()) for c in changes]), abs=0.02)


def test_clips_of_which_no_frame_counts_are_refused(tmp_path):
    write_dataset(tmp_path / "data", "noisebase at 2 spp", {"bistro1": frames(2)}, 2)
    with pytest.raises(BadInput, match="has 2 frames; of 16 the first do not count"):
        published(["noisy"], tmp_path / "data", tmp_path, "quick")


def test_other_data_has_no_published_results(benchmark):
    root, _ = benchmark
    with pytest.raises(BadInput, match="no published results"):
        published(["noisy"], root / "data" / "kitchen", root / "runs", "quick")


def test_samples_of_which_nothing_was_published(tmp_path):
    write_dataset(tmp_path / "data", "noisebase at 1 spp", {"bistro1": frames(1)}, 1)
    with pytest.raises(BadInput, match=r"noisebase at 1 spp, of which nothing is published: .*--spp, one of 2, 4, 8"):
        published(["noisy"], tmp_path / "data", tmp_path, "quick")


def test_published_rows_of_bmfr_have_both_metrics_of_the_paper(tmp_path):
    write_dataset(tmp_path / "data", "bmfr", {"sponza": frames(2)}, 1)
    lines = published(["noisy"], tmp_path / "data", tmp_path, "quick").splitlines()
    assert next(line.split()[-2:] for line in lines if line.startswith("NBGD")) == ["29.47", "0.94"]
    assert "do not say of what they take SSIM" in lines[-1]
