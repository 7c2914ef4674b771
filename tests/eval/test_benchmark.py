"""The benchmark: scenes that are there are rendered and evaluated; published rules; the page for people."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from datasets.clip import Dataset
from datasets.imported import ImportedFrame, write_dataset
from errors import BadInput
from eval.benchmark.page import write_page
from eval.benchmark.published import aces_tone, published
from eval.benchmark.run import Format, entries, list_scenes, located, run
from files import read_json
from scenes.camera import STILL, View, intrinsics, look_at
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
    assert content["digests"]["kitchen"]["files"] == content["digests"]["bedroom"]["files"]
    assert content["by_age"]["psnr"]["svgf"]["fifth"] > content["by_age"]["psnr"]["noisy"]["fifth"]
    assert [row["scene"] for row in content["rendered"]] == ["bedroom", "kitchen"]
    assert all(row["judged"] == 2 and row["seconds"] > 0 for row in content["rendered"])
    assert content["where"]["kitchen"].keys() == {"pixels", "one"}
    assert sum(content["where"]["kitchen"]["one"]["place"].values()) == pytest.approx(1)
    listed = list_scenes(root / "scenes")
    assert listed.count("missing") == len(entries()) - 2 and "Jay-Artist" in listed


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


def test_other_data_has_no_published_results(benchmark):
    root, _ = benchmark
    with pytest.raises(BadInput, match="no published results"):
        published(["noisy"], root / "data" / "kitchen", root / "runs", "quick")
