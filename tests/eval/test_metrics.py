"""Metrics against independent implementations and by hand; noise floors are the scores of the true image."""

import math

import flip_evaluator
import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import peak_signal_noise_ratio as torch_psnr
from torchmetrics.functional.image import structural_similarity_index_measure as torch_ssim

from datasets.frame import disoccluded
from datasets.tonemap import display
from eval.comparison import Comparison
from eval.metrics import METRICS, measure, noise_floors, temporal_error_floor, within_floor


def pair(seed: int = 0, size: tuple[int, int] = (24, 31)) -> tuple[torch.Tensor, torch.Tensor]:
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0, 0.6, (1, 3, *size))
    output = torch.from_numpy(truth + rng.normal(0, 0.05, truth.shape)).float()
    return output, torch.from_numpy(np.concatenate([truth, truth])).float()


def shown(x: torch.Tensor, exposure: float) -> np.ndarray:
    return (np.clip(exposure * x.double().numpy(), 0, 1) ** (1 / 2.2))[0].transpose(1, 2, 0)


def test_metrics_equal_independent_implementations():
    output, buffers = pair()
    exposure = 1.3
    metrics = measure(Comparison(output, buffers, exposure))
    a = shown(output, exposure)
    b = shown(buffers[:1], exposure)
    assert metrics["mse"] == pytest.approx(((a - b) ** 2).mean())
    assert metrics["rmse"] == pytest.approx(math.sqrt(metrics["mse"]))
    assert metrics["l1"] == pytest.approx(np.abs(a - b).mean())
    assert metrics["psnr"] == pytest.approx(peak_signal_noise_ratio(b, a, data_range=1))
    assert metrics["psnr"] == pytest.approx(torch_psnr(torch.from_numpy(a), torch.from_numpy(b), data_range=1.0).item())
    # scikit-image truncates its Gaussian at 3.5 sigma, which is 11 pixels, and crops to valid windows.
    gaussian = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False}
    _, full = structural_similarity(b, a, full=True, data_range=1, channel_axis=2, **gaussian)
    assert metrics["ssim"] == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-6)
    both = (torch.from_numpy(image.transpose(2, 0, 1).copy())[None] for image in (a, b))
    _, full = torch_ssim(*both, sigma=1.5, data_range=1.0, return_full_image=True)
    assert metrics["ssim"] == pytest.approx(full[..., 5:-5, 5:-5].mean().item(), abs=1e-9)
    _, mean, _ = flip_evaluator.evaluate(b.astype(np.float32), a.astype(np.float32), "LDR")
    assert metrics["flip"] == pytest.approx(mean, abs=1e-6)
    x = exposure * output.double().numpy()
    r = exposure * buffers[:1].double().numpy()
    assert metrics["smape"] == pytest.approx((np.abs(x - r) / (np.abs(x) + np.abs(r) + 0.01)).mean())
    assert metrics["rel_mse"] == pytest.approx(((x - r) ** 2 / (r**2 + 0.01)).mean())


def test_identical_constant_and_one_pixel_images():
    _, buffers = pair()
    same = measure(Comparison(buffers[:1], buffers, 1.0))
    assert (same["mse"], same["psnr"], same["mse_unbiased"]) == (0, 100, 0) and same["ssim"] == pytest.approx(1)
    black = torch.zeros(1, 3, 16, 16)
    white = torch.ones(2, 3, 16, 16)
    opposite = measure(Comparison(black, white, 1.0))
    assert opposite["psnr"] == 0 and opposite["rmse"] == 1 and 0 <= opposite["ssim"] < 0.01
    assert measure(Comparison(black, torch.zeros(2, 3, 16, 16), 1.0))["psnr"] == 100
    assert same["flip"] == 0 and opposite["flip"] > 0.9
    one = measure(Comparison(torch.full((1, 3, 1, 1), 0.5), torch.full((2, 3, 1, 1), 0.25), 1.0))
    assert one["ssim"] is None and one["mse_unbiased"] == pytest.approx(0.0625)
    assert 0 < one["flip"] < 1 and one["rel_mse"] == pytest.approx(0.0625 / 0.0725)
    assert one["smape"] == pytest.approx(0.25 / 0.76) and one["l1"] == pytest.approx(one["rmse"])


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (10, 11), (11, 11), (13, 17)])
@pytest.mark.parametrize(("level", "other"), [(0.0, 0.0), (0.0, 6e4), (6e4, 1e-7), (0.3, 0.5)])
def test_metrics_are_finite_and_bounded_on_constant_images(size, level, other):
    found = measure(Comparison(torch.full((1, 3, *size), level), torch.full((2, 3, *size), other), 1.0))
    assert (found["ssim"] is None) == (min(size) < 11)
    assert all(math.isfinite(value) for value in found.values() if value is not None)
    for metric in ("mse", "rmse", "l1", "flip", "smape"):
        assert 0 <= found[metric] <= 1
    if found["ssim"] is not None:  # of constants, its first factor alone
        a, b = (min(1.0, value) ** (1 / 2.2) for value in (level, other))
        assert found["ssim"] == pytest.approx((2 * a * b + 1e-4) / (a**2 + b**2 + 1e-4), abs=1e-6)


def test_non_finite_output_counts_as_zero():
    output, buffers = pair()
    zeroed = output.clone()
    output[0, :, 3, 4] = torch.tensor([math.nan, math.inf, -math.inf])
    zeroed[0, :, 3, 4] = 0
    assert measure(Comparison(output, buffers, 1.0)) == measure(Comparison(zeroed, buffers, 1.0))


def test_unbiased_mse_estimates_the_error_to_the_truth():
    """Closed form: truth t, output t + d, buffers t + noise of variance v; E = d², the plain MSE is biased by v / 2."""
    truth = 0.4
    offset = 0.05
    deviation = 0.2
    rng = np.random.default_rng(0)
    unbiased = []
    plain = []
    for _ in range(200):
        buffers = torch.from_numpy(truth + rng.normal(0, deviation, (2, 3, 32, 32)))
        output = torch.full((1, 3, 32, 32), truth + offset)
        unbiased.append(METRICS["mse_unbiased"].of(Comparison(output, buffers, 1.0)))
        plain.append(float((output - buffers.mean(0)).square().mean()))
    error = np.std(unbiased) / np.sqrt(len(unbiased))
    assert abs(np.mean(unbiased) - offset**2) < 4 * error < 0.1 * offset**2
    assert np.mean(plain) == pytest.approx(offset**2 + deviation**2 / 2, rel=0.02)


def flat(*displayed: float) -> torch.Tensor:
    """Images (N, 3, 4, 4) of one colour each, of radiance that is displayed as given."""
    return torch.stack([torch.full((3, 4, 4), level**2.2) for level in displayed])


def test_temporal_metrics_by_hand():
    first = Comparison(flat(0.2), flat(0.3, 0.3), 1.0, still=True)
    assert all(METRICS[name].of(first) is None for name in ("temporal_error", "tpsnr", "flicker"))
    assert temporal_error_floor(first) is None
    second = Comparison(flat(0.5), flat(0.4, 0.4), 1.0, before=first.as_previous(), still=True)
    assert METRICS["temporal_error"].of(second) == pytest.approx(0.2, abs=1e-6)  # 0.3 of change against 0.1
    assert METRICS["flicker"].of(second) == pytest.approx(0.3, abs=1e-6)
    assert temporal_error_floor(second) == pytest.approx(0, abs=1e-7)
    third = Comparison(flat(0.5), flat(0.5, 0.3), 1.0, before=second.as_previous(), still=False)
    assert temporal_error_floor(third) == pytest.approx(0.1, abs=1e-6)
    assert METRICS["flicker"].of(third) is None
    assert METRICS["tpsnr"].of(second) == pytest.approx(-20 * math.log10(0.2), abs=1e-4)  # errors of -0.1, then 0.1
    same = Comparison(flat(0.8), flat(0.7, 0.7), 1.0, before=second.as_previous())
    assert METRICS["tpsnr"].of(same) == pytest.approx(100)  # 0.1 again
    # Noise of 0, then of (0.5 - 0.3) / 2.
    assert METRICS["tpsnr"].floor(third) == pytest.approx(-20 * math.log10(0.1), abs=1e-4)


def test_disocclusion_counts_only_where_vectors_differ():
    output = torch.full((1, 3, 2, 2), 1.0)
    buffers = torch.zeros(2, 3, 2, 2)
    buffers[:, :, 0, 0] = 1
    motion = torch.zeros(1, 2, 2, 2)
    dual = torch.zeros(1, 2, 2, 2)
    l1 = METRICS["disocclusion_l1"].of
    assert l1(Comparison(output, buffers, 1.0, disoccluded(motion, dual))) is None
    dual[0, 0, 0] = 0.5
    dual[0, 1, 1, 1] = 0.015  # less than 1/64
    assert l1(Comparison(output, buffers, 1.0, disoccluded(motion, dual))) == pytest.approx(0.5)


def noisy_pair(seed: int, noise: float, size: int = 128) -> tuple[np.ndarray, torch.Tensor]:
    """A picture (3, H, W) and two buffers of it (2, 3, H, W) with independent noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:size, 0:size] / 4
    truth = np.broadcast_to(0.3 + 0.1 * np.sin(x) * np.cos(1.7 * y), (3, size, size))
    return truth, torch.from_numpy(truth + noise * rng.normal(size=(2, 3, size, size))).float()


@pytest.mark.parametrize("gain", [0.5, 0.95, 1.2])
def test_energy_is_the_change_of_mean_radiance(gain):
    truth, buffers = noisy_pair(0, 0.05)
    values = measure(Comparison(torch.from_numpy(gain * truth[None]), buffers, 2.0))
    perfect = Comparison(torch.from_numpy(truth[None].copy()), buffers, 2.0)
    error = METRICS["energy"].floor(perfect)
    assert error == pytest.approx(0.05 / math.sqrt(2 * buffers[0].numel()) / 0.3, rel=0.05)
    assert abs(measure(perfect)["energy"]) < 3 * error
    assert values["energy"] == pytest.approx(gain - 1, abs=3 * error)


def test_detail_counts_neither_noise_nor_blur():
    """1 for the truth and for the truth with noise, however noisy the reference; for a blurred image what it keeps."""
    truth, buffers = noisy_pair(1, 0.01)
    noisy = truth + 0.02 * np.random.default_rng(2).normal(size=truth.shape)
    blurred = 0.3 + 0.6 * (truth - 0.3)
    for image, expected in ((truth, 1.0), (noisy, 1.0), (blurred, 0.6)):
        # The tone curve is not linear: within a few per cent where contrast is low.
        value = measure(Comparison(torch.from_numpy(image[None].copy()), buffers, 1.0))["detail"]
        assert value == pytest.approx(expected, rel=0.05)


def test_blocks_flicker_where_their_means_change():
    """White noise, which changes every frame, cancels in blocks; a blotch of a block's size does not."""
    _, buffers = noisy_pair(3, 0.0, 64)
    flat = torch.full((1, 3, 64, 64), 0.3)
    blotch, noise = flat.clone(), flat + 0.01 * torch.randn(flat.shape, generator=torch.Generator().manual_seed(0))
    blotch[..., 16:32, 32:48] *= 1.5
    before, rest = Comparison(flat, buffers, 1.0).as_previous(), torch.zeros(1, 2, 64, 64)
    values = [measure(Comparison(image, buffers, 1.0, None, before, motion=rest)) for image in (flat, noise, blotch)]
    still, white, grown = (value["block_flicker"] for value in values)
    change = float(display(torch.tensor(0.45), 1.0) - display(torch.tensor(0.3), 1.0))
    assert still == 0 and white < 0.1 * values[1]["temporal_error"]
    assert grown == pytest.approx(change / 16, rel=1e-4) == values[2]["temporal_error"]


def test_an_error_that_stays_on_a_surface_does_not_flicker():
    """The picture, with a blotch on it, moves by (5, 3) pixels from one frame to the next."""
    rng = np.random.default_rng(4)
    truth = torch.from_numpy(rng.uniform(0.2, 0.6, (1, 3, 80, 80)))
    wrong = truth.clone()
    wrong[..., 20:44, 24:50] *= 1.3

    def moved(image: torch.Tensor) -> torch.Tensor:
        return torch.roll(image, (3, 5), (2, 3))

    before = Comparison(wrong, truth.repeat(2, 1, 1, 1), 1.0).as_previous()
    arguments = (moved(wrong), moved(truth).repeat(2, 1, 1, 1), 1.0, None, before, False)
    motion = torch.tensor([-5.0, -3.0])[None, :, None, None].expand(1, 2, 80, 80)
    along, at_rest = (METRICS["block_flicker"].of(Comparison(*arguments, m)) for m in (motion, 0 * motion))
    assert along == pytest.approx(0, abs=1e-12) and at_rest > 0.003
    assert METRICS["block_flicker"].of(Comparison(*arguments)) is None  # without motion


@pytest.mark.parametrize("size", [(32, 48), (37, 21), (5, 3)])
def test_block_flicker_pixel_by_pixel(size):
    """In numpy: motion by whole pixels, of which some lead out of the image; some pixels were hidden."""
    rng = np.random.default_rng(5)
    images = [torch.from_numpy(rng.uniform(0.1, 0.6, (3, 3, *size))) for _ in range(2)]
    motion = rng.integers(-4, 5, (2, *size))
    hidden = rng.random(size) < 0.2
    before, now = (Comparison(image[:1], image[1:], 1.0) for image in images)
    found = Comparison(
        *(images[1][:1], images[1][1:], 1.0, torch.from_numpy(hidden)[None, None]),
        *(before.as_previous(), False, torch.from_numpy(motion)[None].float()),
    )
    errors, differences = [], []
    for each in (before.luminances, now.luminances):
        a, b = each.buffers[:, 0].numpy()
        errors.append((each.output - each.reference)[0, 0].numpy())
        differences.append((a - b) / 2)
    for metric, (old, new) in ((METRICS["block_flicker"].of, errors), (METRICS["block_flicker"].floor, differences)):
        blocks: dict[tuple[int, int], list[float]] = {}
        for y, x in np.ndindex(size):
            v, u = y + motion[1, y, x], x + motion[0, y, x]
            if not hidden[y, x] and 0 <= v < size[0] and 0 <= u < size[1]:
                blocks.setdefault((y // 16, x // 16), []).append(new[y, x] - old[v, u])
        assert metric(found) == pytest.approx(np.mean([abs(np.mean(changes)) for changes in blocks.values()]))


# --- Noise floors -----------------------------------------------------------------------------------------------------

HIDDEN = torch.zeros(1, 1, 48, 64, dtype=torch.bool).index_fill(3, torch.arange(8), True)


def floors_of(buffers: torch.Tensor, disoccluded: torch.Tensor | None = None) -> dict[str, float | None]:
    return noise_floors(Comparison(buffers[:1], buffers, 1.0, disoccluded))


def edged_pair(deviation: float, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """A smooth truth (1, 3, 48, 64) with an edge, and noisy buffers of it."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:48, :64] / 64
    truth = np.stack([0.3 + 0.2 * np.sin(6 * x), 0.25 + 0.3 * (x > y), 0.4 + 0.1 * y])[None]
    return torch.from_numpy(truth), torch.from_numpy(truth + rng.normal(0, deviation, (2, *truth.shape[1:])))


@pytest.mark.parametrize("deviation", [0.005, 0.03])
def test_floors_are_the_scores_of_the_truth(deviation):
    found = []
    scored = []
    for seed in range(6):
        truth, buffers = edged_pair(deviation, seed)
        found.append(floors_of(buffers, HIDDEN))
        scored.append(measure(Comparison(truth, buffers, 1.0)))
    for metric in ("mse", "rmse", "l1", "ssim", "flip", "smape", "rel_mse"):
        lacking = 1.0 if metric == "ssim" else 0.0  # SSIM errs in what it lacks of 1
        estimate, truth = (abs(lacking - np.mean([row[metric] for row in rows])) for rows in (found, scored))
        assert estimate == pytest.approx(truth, rel=0.08), metric
    assert np.mean([row["psnr"] for row in found]) == pytest.approx(np.mean([row["psnr"] for row in scored]), abs=0.2)
    assert found[0]["disocclusion_l1"] == pytest.approx(found[0]["l1"], rel=0.2)


def test_the_noise_of_a_single_reference_is_unknown():
    truth, buffers = edged_pair(0.03, 0)
    comparison = Comparison(truth, buffers[:1].expand(2, -1, -1, -1), 1.0, one_reference=True)
    values = measure(comparison)
    assert values["mse_unbiased"] is None and values["detail"] is None and values["psnr"] < 35
    assert set(noise_floors(comparison).values()) == {None}


def test_ssim_between_buffers_would_count_noise_as_structure():
    """Why SSIM has an estimate of its own: on a flat wall its floor is far below the SSIM of a half and the mean."""
    rng = np.random.default_rng(0)
    truth = torch.full((1, 3, 48, 64), 0.4, dtype=torch.float64)
    buffers = truth + torch.from_numpy(rng.normal(0, 0.1, (2, 3, 48, 64)))
    floor = floors_of(buffers)["ssim"]
    naive = measure(Comparison(buffers[:1], buffers.mean(dim=0, keepdim=True).expand(2, -1, -1, -1), 1.0))["ssim"]
    assert floor == pytest.approx(measure(Comparison(truth, buffers, 1.0))["ssim"], abs=0.1)
    assert naive > floor + 0.2


@pytest.mark.parametrize("correlated", [True, False])
@pytest.mark.parametrize("metric", ["mse_unbiased", "energy"])
def test_standard_errors(metric, correlated):
    """The spread over references of a perfect image; that of the unbiased MSE is a bound where noise is coloured."""
    rng = np.random.default_rng(1)
    truth = torch.full((1, 3, 24, 24), 0.5, dtype=torch.float64)
    values = []
    errors = []
    for _ in range(400):
        noise = torch.from_numpy(rng.normal(0, 0.1, (2, 1 if correlated else 3, 24, 24))).expand(2, 3, -1, -1)
        buffers = truth + noise
        comparison = Comparison(truth, buffers, 1.0)
        values.append(METRICS[metric].of(comparison))
        errors.append(METRICS[metric].floor(comparison))
    ratio = np.mean(errors) / np.std(values)
    assert 0.9 < ratio < 1.1 if correlated or metric == "energy" else 1 < ratio < 2.5
    assert abs(np.mean(values)) < 4 * np.std(values) / math.sqrt(len(values))


def test_floors_at_the_extremes():
    black = torch.zeros(2, 3, 16, 16)
    floors = floors_of(black)
    assert floors.pop("psnr") == 100 and floors.pop("ssim") == pytest.approx(1)
    undefined = {name for name in floors if floors[name] is None}
    assert undefined == {"disocclusion_l1", "temporal_error", "tpsnr", "block_flicker", "energy"}
    assert {floors[name] for name in floors.keys() - undefined} == {0.0}
    one = floors_of(torch.tensor([0.2, 0.4])[:, None, None, None].expand(2, 3, 1, 1))
    assert one["ssim"] is None and one["rel_mse"] == pytest.approx(0.1**2 / (0.3**2 + 0.01))
    bright = floors_of(torch.full((2, 3, 16, 16), 6e4))
    assert all(value is None or math.isfinite(value) for value in bright.values())


@pytest.mark.parametrize(
    ("metric", "floor", "inside", "outside"),
    [
        ("mse", 0.01, 0.0199, 0.0201),
        ("rmse", 0.1, 0.1414, 0.1415),
        ("l1", 0.1, 0.14, 0.15),
        ("psnr", 40.0, 37.0, 36.9),
        ("ssim", 0.9, 0.81, 0.79),
        ("mse_unbiased", 0.1, -0.19, -0.21),
        ("temporal_error", 0.0, 0.0, 1e-9),
    ],
)
def test_values_within_the_floor_are_as_close_to_the_truth_as_the_reference(metric, floor, inside, outside):
    assert within_floor(metric, inside, floor) and not within_floor(metric, outside, floor)


def test_no_floor_no_mark():
    assert not any(within_floor(metric, 0.0, None) or within_floor(metric, None, 0.0) for metric in METRICS)
    assert not within_floor("temporal_error_floor", 0.1, 0.1)
