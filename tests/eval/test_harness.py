"""Metrics against independent implementations, and the harness end to end."""

import contextlib
import io
import json
import math

import flip_evaluator
import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import peak_signal_noise_ratio as torch_psnr
from torchmetrics.functional.image import structural_similarity_index_measure as torch_ssim

from datasets.clip import Dataset
from datasets.tonemap import display
from errors import BadInput
from eval import harness
from eval.harness import evaluate
from eval.metrics import TemporalMetrics, disocclusion_l1, image_metrics, luminance
from models import registry
from models.registry import create
from models.weights import save_weights
from train.task import run_folder


def pair(seed: int = 0, size: tuple[int, int] = (24, 31)) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0, 0.6, (1, 3, *size))
    output = torch.from_numpy(truth + rng.normal(0, 0.05, truth.shape)).float()
    return output, torch.from_numpy(np.concatenate([truth, truth])).float()


def shown(x: torch.Tensor, exposure: float) -> np.ndarray:
    return (np.clip(exposure * x.double().numpy(), 0, 1) ** (1 / 2.2))[0].transpose(1, 2, 0)


def test_metrics_equal_independent_implementations():
    output, halves = pair()
    exposure = 1.3
    metrics = image_metrics(output, halves, exposure)
    a, b = shown(output, exposure), shown(halves[:1], exposure)
    assert metrics["mse"] == pytest.approx(((a - b) ** 2).mean())
    assert metrics["rmse"] == pytest.approx(math.sqrt(metrics["mse"]))
    assert metrics["l1"] == pytest.approx(np.abs(a - b).mean())
    assert metrics["psnr"] == pytest.approx(peak_signal_noise_ratio(b, a, data_range=1))
    assert metrics["psnr"] == pytest.approx(torch_psnr(torch.from_numpy(a), torch.from_numpy(b), data_range=1.0).item())
    # scikit-image truncates its Gaussian at 3.5 sigma, which is 11 pixels, and crops to valid windows.
    options = {
        "gaussian_weights": True,
        "sigma": 1.5,
        "use_sample_covariance": False,
        "data_range": 1,
        "channel_axis": 2,
    }
    _, full = structural_similarity(b, a, full=True, **options)
    assert metrics["ssim"] == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-6)
    both = (torch.from_numpy(image.transpose(2, 0, 1).copy())[None] for image in (a, b))
    _, full = torch_ssim(*both, sigma=1.5, data_range=1.0, return_full_image=True)
    assert metrics["ssim"] == pytest.approx(full[..., 5:-5, 5:-5].mean().item(), abs=1e-9)
    _, mean, _ = flip_evaluator.evaluate(b.astype(np.float32), a.astype(np.float32), "LDR")
    assert metrics["flip"] == pytest.approx(mean, abs=1e-6)
    x, r = exposure * output.double().numpy(), exposure * halves[:1].double().numpy()
    assert metrics["smape"] == pytest.approx((np.abs(x - r) / (np.abs(x) + np.abs(r) + 0.01)).mean())
    assert metrics["rel_mse"] == pytest.approx(((x - r) ** 2 / (r**2 + 0.01)).mean())


def test_identical_constant_and_one_pixel_images():
    _, halves = pair()
    same = image_metrics(halves[:1], halves, 1.0)
    assert (same["mse"], same["psnr"], same["mse_unbiased"]) == (0, 100, 0) and same["ssim"] == pytest.approx(1)
    black, white = torch.zeros(1, 3, 16, 16), torch.ones(2, 3, 16, 16)
    opposite = image_metrics(black, white, 1.0)
    assert opposite["psnr"] == 0 and opposite["rmse"] == 1 and 0 <= opposite["ssim"] < 0.01
    assert image_metrics(black, torch.zeros(2, 3, 16, 16), 1.0)["psnr"] == 100
    assert same["flip"] == 0 and opposite["flip"] > 0.9
    one = image_metrics(torch.full((1, 3, 1, 1), 0.5), torch.full((2, 3, 1, 1), 0.25), 1.0)
    assert one["ssim"] is None and one["mse_unbiased"] == pytest.approx(0.0625)
    assert 0 < one["flip"] < 1 and one["rel_mse"] == pytest.approx(0.0625 / 0.0725)
    assert one["smape"] == pytest.approx(0.25 / 0.76) and one["l1"] == pytest.approx(one["rmse"])


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (10, 11), (11, 11), (13, 17)])
@pytest.mark.parametrize(("level", "other"), [(0.0, 0.0), (0.0, 6e4), (6e4, 1e-7), (0.3, 0.5)])
def test_metrics_are_finite_and_bounded_on_constant_images(size, level, other):
    found = image_metrics(torch.full((1, 3, *size), level), torch.full((2, 3, *size), other), 1.0)
    assert (found["ssim"] is None) == (min(size) < 11)
    assert all(math.isfinite(value) for value in found.values() if value is not None)
    for metric in ("mse", "rmse", "l1", "flip", "smape"):
        assert 0 <= found[metric] <= 1
    if found["ssim"] is not None:  # of constants, its first factor alone
        a, b = (min(1.0, value) ** (1 / 2.2) for value in (level, other))
        assert found["ssim"] == pytest.approx((2 * a * b + 1e-4) / (a**2 + b**2 + 1e-4), abs=1e-6)


def test_non_finite_output_counts_as_zero():
    output, halves = pair()
    zeroed = output.clone()
    output[0, :, 3, 4] = torch.tensor([math.nan, math.inf, -math.inf])
    zeroed[0, :, 3, 4] = 0
    assert image_metrics(output, halves, 1.0) == image_metrics(zeroed, halves, 1.0)


def test_unbiased_mse_estimates_the_error_to_the_truth():
    """Closed form: truth t, output t + d, halves t + noise of variance v. E = d^2; the plain MSE is biased by v / 2."""
    truth, offset, deviation = 0.4, 0.05, 0.2
    rng = np.random.default_rng(0)
    unbiased, plain = [], []
    for _ in range(200):
        halves = torch.from_numpy(truth + rng.normal(0, deviation, (2, 3, 32, 32)))
        output = torch.full((1, 3, 32, 32), truth + offset)
        unbiased.append(image_metrics(output, halves, 1.0)["mse_unbiased"])
        plain.append(float((output - halves.mean(0)).square().mean()))
    error = np.std(unbiased) / np.sqrt(len(unbiased))
    assert abs(np.mean(unbiased) - offset**2) < 4 * error < 0.1 * offset**2
    assert np.mean(plain) == pytest.approx(offset**2 + deviation**2 / 2, rel=0.02)


def test_temporal_metrics_by_hand():
    temporal = TemporalMetrics()
    flat = lambda *levels: torch.stack([torch.full((3, 4, 4), level) for level in levels])  # noqa: E731
    to = lambda y: y**2.2  # noqa: E731 - radiance that is displayed as y
    first = temporal.update(flat(to(0.2)), flat(to(0.3), to(0.3)), 1.0, still=True)
    assert set(first.values()) == {None}
    second = temporal.update(flat(to(0.5)), flat(to(0.4), to(0.4)), 1.0, still=True)
    assert second["temporal_error"] == pytest.approx(0.2, abs=1e-6)  # 0.3 of change against 0.1
    assert second["flicker"] == pytest.approx(0.3, abs=1e-6) and second["temporal_error_floor"] == pytest.approx(
        0, abs=1e-7
    )
    third = temporal.update(flat(to(0.5)), flat(to(0.5), to(0.3)), 1.0, still=False)
    assert third["temporal_error_floor"] == pytest.approx(0.1, abs=1e-6) and third["flicker"] is None


def test_disocclusion_counts_only_where_vectors_differ():
    output, halves = torch.full((1, 3, 2, 2), 1.0), torch.zeros(2, 3, 2, 2)
    halves[:, :, 0, 0] = 1
    motion, dual = torch.zeros(1, 2, 2, 2), torch.zeros(1, 2, 2, 2)
    assert disocclusion_l1(output, halves, 1.0, motion, dual) is None
    dual[0, 0, 0] = 0.5
    dual[0, 1, 1, 1] = 0.015  # less than 1/64
    assert disocclusion_l1(output, halves, 1.0, motion, dual) == pytest.approx(0.5)


def test_display_and_luminance():
    x = torch.tensor([0.0, 0.25, 2.0])[None, :, None, None]
    torch.testing.assert_close(display(x, 2.0).flatten(), torch.tensor([0.0, 0.5 ** (1 / 2.2), 1.0]))
    assert luminance(torch.ones(1, 3, 1, 1)).item() == pytest.approx(1)


METRICS = {
    *("mse", "rmse", "l1", "psnr", "ssim", "flip", "mse_unbiased", "smape", "rel_mse"),
    *("temporal_error", "temporal_error_floor", "flicker", "disocclusion_l1"),
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
        evaluate(tiny, runs, "tiny", ["noisy", "accumulated", *TRAINED])
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
    mse, rmse, floor = [], [], []
    for i in range(clip.frames):
        noisy = sum(np.float32(clip.read(name, i)) for name in lights)
        references = (name if name == "emission" else f"{name}_reference" for name in lights)
        halves = sum(np.float64(clip.read(name, i)) for name in references)
        x, r, a, b = (np.clip(clip.exposure * v, 0, 1) ** (1 / 2.2) for v in (noisy, halves.mean(0), *halves))
        mse.append(((x - r) ** 2).mean())
        rmse.append(np.sqrt(mse[-1]))
        floor.append(((a - b) ** 2).mean() / 4)
    assert row["metrics"]["mse"] == pytest.approx(np.mean(mse), rel=1e-4)
    assert row["metrics"]["rmse"] == pytest.approx(np.mean(rmse), rel=1e-4)
    lines = (line.split() for line in (runs / "table.txt").read_text().splitlines())
    (printed,) = (line for line in lines if line[:4] == [f"{clip.scene}/{clip.name}", "(noise", "floor)", signal])
    assert float(printed[4]) == pytest.approx(np.mean(np.sqrt(floor)), abs=1e-4)


def test_pictures_show_every_denoiser_and_the_reference(runs):
    from matplotlib import image

    for scene in ("cornell_box", "cornell_box_moving"):
        for ending in ("", "-indirect"):
            picture = image.imread(runs / "eval" / f"{scene}-000{ending}.png")
            assert picture.shape[1] == pytest.approx(4 * 256, abs=4) and picture.shape[0] >= 256
            panels = np.array_split(picture[60:, :, :3], 4, axis=1)
            assert all(panel.std() > 0.02 for panel in panels)
            assert panels[0][:, :250].tobytes() != panels[3][:, :250].tobytes()
        whole, indirect = (
            image.imread(runs / "eval" / f"{scene}-000{e}.png")[60:, -250:, :3] for e in ("", "-indirect")
        )
        assert indirect.mean() < 0.8 * whole.mean()  # the references: direct light is most of it


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["noisy", "rae"], {("noisy", "total"), ("rae", "total")}),
        (["ntd", "noisy"], {("ntd", "indirect"), ("noisy", "total"), ("noisy", "indirect")}),
        (["ntd"], {("ntd", "indirect")}),
    ],
)
def test_baselines_of_indirect_light_run_only_beside_who_needs_them(names, expected):
    tracks = harness.tracks_of({name: (create(name), None) for name in names})
    assert {(track.name, track.denoiser.signal) for track in tracks} == expected and len(tracks) == len(expected)


def test_named_denoiser_without_weights_is_an_error_else_skipped(tiny, tmp_path, capsys, monkeypatch):
    with pytest.raises(BadInput, match="onespp train rae"):
        evaluate(tiny, tmp_path, "tiny", ["rae"])
    few = {name: registry.DENOISERS[name] for name in ("noisy", "accumulated", "rae")}
    monkeypatch.setattr(harness, "DENOISERS", few)
    results = evaluate(tiny, tmp_path, "tiny")
    assert {row["denoiser"] for row in results["rows"]} == {"noisy", "accumulated"}
    assert "rae: skipped" in capsys.readouterr().out
