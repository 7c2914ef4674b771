"""Clips with references of some frames only: the rest is denoised, not measured."""

import numpy as np
import pytest
import torch

from datasets.clip import Clip
from datasets.exr import export_clip
from datasets.frame import read_frame
from errors import BadInput
from eval.error_location import PLACE_CHANNELS, error_shares, places, where
from eval.harness import evaluate
from eval.report.page import report
from eval.results import read_results
from eval.shipped import measurements
from eval.tradeoff.run import trade
from files import read_json
from models.spec import DenoiserSpec
from render.job.generate import generate
from render.scene_file.description import read_description
from tests.eval.conftest import bench_of
from tests.helpers.scene_files import write, xml
from tests.helpers.training import fresh_weights

JUDGED = [1, 2, 4]
TOML = "[splits.train]\nclips = 0\n[splits.val]\nclips = 0\n[splits.test]\nreference_spp = 8\nmost_spp = 8\n"
NAMES = ("noisy", "svgf")


def results_of(folder, toml):
    """The dataset of a scene with that TOML, evaluated: its only clip, and results by denoiser."""
    folder.mkdir()
    path = write(folder, xml())
    path.write_text(f'file = "scene.xml"\nresolution = [24, 24]\nframes = 5\n{TOML}{toml}')
    generate(folder / "data", str(path), seed=0, reads=())
    evaluate([folder / "data"], folder, "quick", NAMES)
    _, (clip,) = read_results(folder)
    return Clip(folder / "data" / "test" / "my" / "000"), clip


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """With references of all frames, and with some."""
    root = tmp_path_factory.mktemp("judged")
    return root, results_of(root / "all", ""), results_of(root / "some", f"judged = {JUDGED}\n")


def test_judged_frames_have_the_references_and_metrics_that_they_always_have(both):
    _, (full, all_results), (sparse, results) = both
    assert sparse.judged == JUDGED and full.judged == [*range(5)]
    assert sparse.map("direct_reference").shape[0] == len(JUDGED) < full.map("direct_reference").shape[0]
    for frame in JUDGED:
        assert np.array_equal(sparse.reference(frame), full.reference(frame))
    for ours, theirs in zip(results.results, all_results.results, strict=True):
        for frame, (values, wanted) in enumerate(zip(ours.frames, theirs.frames, strict=True)):
            if frame not in JUDGED:
                assert values == {}
                continue
            ratio = values["mse"] / wanted["mse"]  # the exposure is that of the judged frames
            assert ratio == pytest.approx(1, rel=0.2)
            # What changes in time needs the frame before as well.
            assert (values["temporal_error"] is None) == (frame != 2)


@pytest.mark.usefixtures("no_live_page")
def test_what_needs_references_takes_the_judged_frames(both):
    root, _, (sparse, results) = both
    page, animation = report(root / "some")
    assert page.exists() and animation.exists()
    assert results.reference.judged == JUDGED
    assert export_clip(sparse.path, root / "exr") == 5
    with pytest.raises(BadInput, match=r"no reference of frame 0: `judged`"):
        sparse.reference(0)


def test_errors_are_located_in_judged_frames(both):
    """Shares of the pixels by place and roughness, which need no reference, are those of the judged frames alone."""
    root, _, (sparse, _) = both
    found = error_shares(sparse, [DenoiserSpec.named("noisy")])["pixels"]
    masks = {index: places(read_frame(sparse, index, PLACE_CHANNELS), torch.ones(1, 3, 24, 24)) for index in range(5)}
    for key in (key for key in found if key[0] in ("place", "roughness")):
        shares = {index: float(masks[index][key].double().mean()) for index in masks}
        assert float(found[key]) == pytest.approx(np.mean([shares[index] for index in JUDGED]))
    inside = [float(masks[index]["place", "inside"].double().mean()) for index in masks]
    assert np.ptp(inside) > 0  # the camera moves
    assert "mesh edges" in where([root / "some" / "data"], root / "where", "quick", NAMES)


def test_quality_is_traded_on_judged_frames(both, tmp_path):
    """With other samples a pixel, too."""
    root, _, (_, results) = both
    bench_of(tmp_path, {"noisy": 1.0, "svgf": 2.0}, (24, 24), threads=(1,))
    trade(root / "some" / "data", tmp_path, "quick", (1, 4), NAMES)
    content = read_json(tmp_path / "report" / "trade.json")
    psnr = {(row["denoiser"], row["spp"]): row["metrics"]["psnr"] for row in content["samples"]}
    for result in results.results:
        assert psnr[result.denoiser, 1] == pytest.approx(result.metrics["psnr"])
        assert result.metrics["psnr"] == pytest.approx(np.mean([result.frames[index]["psnr"] for index in JUDGED]))
    assert psnr["noisy", 4] > psnr["noisy", 1] + 3
    (more,) = (tmp_path / "trade" / "data").glob("**/000-4spp")
    assert Clip(more).judged == JUDGED and Clip(more).frames == 5


def test_cards_measure_judged_frames(both, tmp_path, shipped):
    root, *_ = both
    weights = fresh_weights("wskp3", shipped / "wskp3.safetensors")
    evaluate([root / "some" / "data"], tmp_path, "quick", ["noisy", "wskp3"])
    measured = measurements("wskp3", tmp_path)
    result = next(r for r in read_results(tmp_path)[1][0].results if r.denoiser == "wskp3")
    assert result.judged == JUDGED and weights.exists()
    psnr = f"{np.mean([result.frames[index]['psnr'] for index in JUDGED]):.2f}"
    row = next(row for row in measured["means"] if row["denoiser"] == "wskp3")
    assert row["PSNR dB"].lstrip("≈") == psnr == measured["psnr"][0]["wskp3"].lstrip("≈")


@pytest.mark.parametrize(
    ("split", "frames", "reason"),
    [("train", [0], "unknown field `judged`"), ("test", [1, 0], "rising order"), ("test", [2], "from 0 to 1")],
)
def test_frames_that_cannot_be_judged_are_refused(tmp_path, split, frames, reason):
    path = write(tmp_path, xml(), f"[splits.{split}]\njudged = {frames}\n")
    with pytest.raises(BadInput, match=reason):
        read_description(path)
