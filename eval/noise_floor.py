"""Noise floors: what the truth itself would score against a noisy reference, from the reference's two halves.

The mean of the halves A and B is off the truth by as much as (A - B) / 2 is off zero: both have the same variance. The
mean errs by (a + b) / 2 where the halves err by a and b, and (A - B) / 2 = (a - b) / 2. So squared errors are exact in
expectation, and mean absolute ones as far as noise is as often too high as too low. docs/evaluation.md measures it.
"""

import math

from torch import Tensor

from datasets.frame import disoccluded
from datasets.tonemap import display, psnr
from eval.metrics import EPSILON, METRICS, flip
from eval.ssim import ssim_floor

SQUARED = ("mse", "rel_mse")


def noise_floor(halves: Tensor, exposure: float, motion: Tensor, dual_motion: Tensor) -> dict[str, float | None]:
    """What each metric of one frame would be for a perfect image, `mse_unbiased` apart.

    That one has no floor, for the reference's noise does not bias it; its entry is its standard error for a perfect
    image, at most, if noise is Gaussian and pixels are independent: with D = A - B, E|D|^4 >= 12 tr(S^2) for
    covariance S of a half's three channels, and tr(S^2) / 9 is the variance of the mean of a pixel's three products.

    Args:
        halves: the two independent halves (2, 3, H, W) of the reference radiance.
        motion, dual_motion: (1, 2, H, W), which tell what is disoccluded.
    """
    halves = halves.double()
    a, b = display(halves, exposure).split(1)
    noise, hidden = (a - b) / 2, disoccluded(motion, dual_motion)
    mse = noise.square().mean().item()
    linear, reference = exposure * (halves[0] - halves[1]) / 2, exposure * halves.mean(dim=0)
    product_variance = (2 * linear).square().sum(dim=0).square() / 12 / 9
    return {
        "mse": mse,
        "rmse": math.sqrt(mse),
        "l1": noise.abs().mean().item(),
        "psnr": psnr(mse),
        "ssim": ssim_floor(a, b),
        "flip": flip((a + b) / 2, a),
        "mse_unbiased": product_variance.sum().sqrt().item() / product_variance.numel(),
        "smape": (linear.abs() / (2 * reference.abs() + EPSILON)).mean().item(),
        "rel_mse": (linear.square() / (reference.square() + EPSILON)).mean().item(),
        "disocclusion_l1": noise.abs().mean(dim=1, keepdim=True)[hidden].mean().item() if hidden.any() else None,
    }


def within_floor(metric: str, value: float | None, floor: float | None) -> bool:
    """Whether a value says no more than that the image is at least as close to the truth as the reference is.

    Noise of reference and error of the image add up: as variances, so up to twice the floor for squared errors and for
    what SSIM lacks of 1, half of it for PSNR, and the square root of two times it for absolute ones. An unbiased MSE
    is within two standard errors of 0.
    """
    if value is None or floor is None or metric not in METRICS:
        return False
    limit = floor_limit(metric, floor)
    return value >= limit if METRICS[metric].more_is_better else abs(value) <= limit


def floor_limit(metric: str, floor: float) -> float:
    """The value from which on `within_floor` holds; of the unbiased MSE its magnitude."""
    if metric == "psnr":
        return floor - 10 * math.log10(2)
    if metric == "ssim":
        return 1 - 2 * (1 - floor)
    return floor * (2 if metric in (*SQUARED, "mse_unbiased") else math.sqrt(2))
