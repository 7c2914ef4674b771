"""The harness end to end."""

import contextlib
import io
import json
import re
import shutil

import numpy as np
import pytest
import torch

from datasets.clip import Dataset
from errors import BadInput
from eval import selection
from eval.harness import evaluate, named_denoisers, strip
from eval.results import load_picture, read_results
from files import read_json, write_json
from models import registry
from models.registry import create
from models.spec import DenoiserSpec
from models.weights import save_weights
from train.task import run_folder

METRICS = {
    *("mse", "rmse", "l1", "psnr", "ssim", "flip", "mse_unbiased", "smape", "rel_mse"),
    *("temporal_error", "temporal_error_floor", "flicker", "disocclusion_l1", "energy", "detail", "block_flicker"),
}


TRAINED = ("rae", "ntd")
ROWS = {
    *(("noisy", "total"), ("accumulated", "total"), ("rae", "total")),
    *(("noisy", "indirect"), ("accumulated", "indirect"), ("ntd", "indirect")),
}


@pytest.fixture(scope="module")
def runs(tiny, tmp_path_factory):
    """Results on the tiny data, of networks with fresh weights; the table that was printed is in table.txt."""
    runs = tmp_path_factory.mktemp("runs")
    torch.manual_seed(0)
    for name in TRAINED:
        folder = run_folder(runs, name, "tiny")
        folder.mkdir(parents=True)
        save_weights(create(name), name, {}, folder / "weights.safetensors")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        evaluate([tiny], runs, "tiny", ["noisy", "accumulated", *TRAINED])
    (runs / "table.txt").write_text(printed.getvalue())
    return runs


def test_results_file_has_the_agreed_form(runs, tiny):
    results = json.loads((runs / "eval" / "results.json").read_text())
    assert results.keys() == {"schema", "dataset", "device", "versions", "rows"} and results["schema"] == 1
    assert len(results["rows"]) == len(ROWS) * 2
    assert {(row["denoiser"], row["signal"]) for row in results["rows"]} == ROWS
    for row in results["rows"]:
        assert row.keys() == {"denoiser", "signal", "weights", "scene", "clip", "frames", "metrics", "nonfinite"}
        assert row["metrics"].keys() == METRICS
        assert (row["weights"] is None) == (row["denoiser"] not in TRAINED)
        assert row["frames"] == 8 and row["nonfinite"] == 0
        assert row["metrics"]["flicker"] is None  # the camera moves


@pytest.mark.parametrize(
    ("signal", "lights"), [("total", ("direct", "indirect", "emission")), ("indirect", ("indirect",))]
)
def test_results_are_the_means_of_frames(runs, tiny, signal, lights):
    """The rows of `noisy`, and the noise floors below them, recomputed with numpy from the files."""
    results = json.loads((runs / "eval" / "results.json").read_text())
    clip = Dataset(tiny).clips("test")[0]
    key = ("noisy", signal, clip.scene)
    (row,) = (r for r in results["rows"] if (r["denoiser"], r["signal"], r["scene"]) == key)
    mse = []
    rmse = []
    floor = []
    for i in range(clip.frames):
        noisy = sum(np.float32(clip.read(name, i)) for name in lights)
        references = (name if name == "emission" else f"{name}_reference" for name in lights)
        buffers = sum(np.float64(clip.read(name, i)) for name in references)
        x, r, a, b = (np.clip(clip.exposure * v, 0, 1) ** (1 / 2.2) for v in (noisy, buffers.mean(0), *buffers))
        mse.append(((x - r) ** 2).mean())
        rmse.append(np.sqrt(mse[-1]))
        floor.append(((a - b) ** 2).mean() / 4)
    assert row["metrics"]["mse"] == pytest.approx(np.mean(mse), rel=1e-4)
    assert row["metrics"]["rmse"] == pytest.approx(np.mean(rmse), rel=1e-4)
    lines = (line.split() for line in (runs / "table.txt").read_text().splitlines())
    (printed,) = (line for line in lines if line[:4] == [f"{clip.scene}/{clip.name}", "(noise", "floor)", signal])
    assert float(printed[4]) == pytest.approx(np.mean(np.sqrt(floor)), abs=1e-4)


def test_strips_show_every_denoiser_and_the_reference(runs):
    _, clips = read_results(runs)
    for clip in clips:
        axes = strip(runs, clip).axes
        ending = "" if clip.signal == "total" else "-indirect"
        assert (runs / "eval" / f"{clip.scene}-000{ending}.png").exists()
        for result, panel in zip((*clip.results, clip.reference), axes, strict=True):
            picture = load_picture(runs / "eval" / "clips" / f"{clip.scene}-000" / f"{result.denoiser}{ending}", 6)
            np.testing.assert_array_equal(panel.images[0].get_array(), picture / 255)
            assert panel.get_title().startswith(result.denoiser) and ("RMSE" in panel.get_title()) != result.floor


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["noisy", "rae"], {("noisy", "total"), ("rae", "total")}),
        (["ntd", "noisy"], {("ntd", "indirect"), ("noisy", "total"), ("noisy", "indirect")}),
        (["ntd"], {("ntd", "indirect")}),
    ],
)
def test_baselines_of_indirect_light_run_only_where_needed(names, expected):
    denoisers = named_denoisers([DenoiserSpec.named(name) for name in names])
    assert {(named_denoiser.name, named_denoiser.denoiser.signal) for named_denoiser in denoisers} == expected
    assert len(denoisers) == len(expected)


def test_named_denoiser_without_weights_is_an_error_else_skipped(tiny, tmp_path, capsys, monkeypatch, shipped):
    with pytest.raises(BadInput, match="onespp train rae"):
        evaluate([tiny], tmp_path, "tiny", ["rae"])
    few = {name: registry.DENOISERS[name] for name in ("noisy", "accumulated", "rae")}
    monkeypatch.setattr(selection, "DENOISERS", few)
    results = evaluate([tiny], tmp_path, "tiny")
    assert {row["denoiser"] for row in results["rows"]} == {"noisy", "accumulated"}
    assert re.search(r"\brae\b.*: skipped", capsys.readouterr().out)


def test_several_data_sets_are_one_table(tiny, tmp_path):
    """Clips of all of them; one name cannot stand for two clips."""
    other = tmp_path / "other"
    shutil.copytree(tiny, other)
    with pytest.raises(BadInput, match=f"{other} both have cornell_box/000"):
        evaluate([tiny, other], tmp_path, "tiny", ["noisy"])
    for path in (tiny / "test").iterdir():
        (other / "test" / path.name).rename(other / "test" / f"other_{path.name}")
    facts = read_json(other / "dataset.json", ())
    facts["splits"]["test"] = [f"other_{clip}" for clip in facts["splits"]["test"]]
    write_json(other / "dataset.json", facts)
    rows = evaluate([tiny, other], tmp_path, "tiny", ["noisy"])["rows"]
    scenes = {path.name for path in (tiny / "test").iterdir()}
    assert {row["scene"] for row in rows} == scenes | {f"other_{scene}" for scene in scenes}
