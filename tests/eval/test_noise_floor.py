"""Noise floors are the scores of the true image, in closed form."""

import math

import numpy as np
import pytest
import torch

from eval.comparison import Comparison
from eval.metrics import METRICS, noise_floors, within_floor
from eval.metrics import measure as measure_frame

HIDDEN = torch.zeros(1, 1, 48, 64, dtype=torch.bool).index_fill(3, torch.arange(8), True)


def floors_of(buffers: torch.Tensor, disoccluded: torch.Tensor | None = None) -> dict[str, float | None]:
    return noise_floors(Comparison(buffers[:1], buffers, 1.0, disoccluded))


def scene(deviation: float, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
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
        truth, buffers = scene(deviation, seed)
        found.append(floors_of(buffers, HIDDEN))
        scored.append(measure_frame(Comparison(truth, buffers, 1.0)))
    for metric in ("mse", "rmse", "l1", "ssim", "flip", "smape", "rel_mse"):
        lacking = 1.0 if metric == "ssim" else 0.0  # SSIM errs in what it lacks of 1
        estimate, truth = (abs(lacking - np.mean([row[metric] for row in rows])) for rows in (found, scored))
        assert estimate == pytest.approx(truth, rel=0.08), metric
    assert np.mean([row["psnr"] for row in found]) == pytest.approx(np.mean([row["psnr"] for row in scored]), abs=0.2)
    assert found[0]["disocclusion_l1"] == pytest.approx(found[0]["l1"], rel=0.2)


def test_ssim_between_buffers_would_count_noise_as_structure():
    """Why SSIM has an estimate of its own: on a flat wall its floor is far below the SSIM of a half and the mean."""
    rng = np.random.default_rng(0)
    truth = torch.full((1, 3, 48, 64), 0.4, dtype=torch.float64)
    buffers = truth + torch.from_numpy(rng.normal(0, 0.1, (2, 3, 48, 64)))
    floor = floors_of(buffers)["ssim"]
    naive = measure_frame(Comparison(buffers[:1], buffers.mean(dim=0, keepdim=True).expand(2, -1, -1, -1), 1.0))["ssim"]
    assert floor == pytest.approx(measure_frame(Comparison(truth, buffers, 1.0))["ssim"], abs=0.1)
    assert naive > floor + 0.2


@pytest.mark.parametrize("correlated", [True, False])
def test_error_of_the_unbiased_mse(correlated):
    """Its spread over references of a perfect image: met where channels share their noise, else bounded."""
    rng = np.random.default_rng(1)
    truth = torch.full((1, 3, 24, 24), 0.5, dtype=torch.float64)
    values = []
    errors = []
    for _ in range(400):
        noise = torch.from_numpy(rng.normal(0, 0.1, (2, 1 if correlated else 3, 24, 24))).expand(2, 3, -1, -1)
        buffers = truth + noise
        comparison = Comparison(truth, buffers, 1.0)
        values.append(METRICS["mse_unbiased"].of(comparison))
        errors.append(METRICS["mse_unbiased"].floor(comparison))
    ratio = np.mean(errors) / np.std(values)
    assert 0.9 < ratio < 1.1 if correlated else 1 < ratio < 2.5
    assert abs(np.mean(values)) < 4 * np.std(values) / math.sqrt(len(values))


def test_floors_at_the_extremes():
    black = torch.zeros(2, 3, 16, 16)
    floors = floors_of(black)
    assert floors.pop("psnr") == 100 and floors.pop("ssim") == pytest.approx(1)
    undefined = {name for name in floors if floors[name] is None}
    assert undefined == {"disocclusion_l1", "temporal_error", "block_flicker", "energy"}
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
