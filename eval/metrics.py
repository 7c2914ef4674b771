"""The metrics: a row of METRICS each, with its noise floor. docs/evaluation.md says what they mean.

A noise floor is what the truth itself would score against a noisy reference. The mean of the two halves A and B is off
the truth by as much as (A - B) / 2 is off zero: both have the same variance. With a and b the errors of the halves, the
mean errs by (a + b) / 2, and (A - B) / 2 = (a - b) / 2. So floors of squared errors are exact in expectation, those of
absolute ones as far as noise is as often too high as too low.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import flip_evaluator
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from datasets.tonemap import psnr
from eval.comparison import Comparison
from eval.ssim import ssim, ssim_floor

EPSILON = 0.01

Values = dict[str, float | None]  # by metric; None where undefined


def twice(floor: float) -> float:
    """Squared errors of image and reference add up."""
    return 2 * floor


def root_two_times(floor: float) -> float:
    """Of absolute errors, the squares do."""
    return math.sqrt(2) * floor


@dataclass(frozen=True)
class Quantity:
    """How numbers of a kind are shown: under which title, in which form."""

    title: str
    form: str
    more_is_better: bool = False


@dataclass(frozen=True, kw_only=True)
class Metric(Quantity):
    """One row of the table.

    Attributes:
        of: measures a frame; None where the metric is undefined.
        floor: the noise floor of a frame; None where noise of the reference does not enter.
        edge: from the floor, the value at which noise of the reference is as large as the image's own error.
        floor_is_error: the floor is a standard error around 0, for noise does not bias the metric.
    """

    of: Callable[[Comparison], float | None]
    floor: Callable[[Comparison], float | None] | None
    edge: Callable[[float], float] = root_two_times
    floor_is_error: bool = False


def flip_map(x: NDArray[np.floating], reference: NDArray[np.floating]) -> NDArray[np.float32]:
    """LDR-FLIP (H, W) in [0, 1] (Andersson et al. 2020) of displayed images (H, W, 3), at its default distance."""
    images = (np.ascontiguousarray(image, dtype=np.float32) for image in (reference, x))
    errors: NDArray[np.float32] = flip_evaluator.evaluate(*images, "LDR", applyMagma=False)[0]
    return errors.reshape(x.shape[:2])


def flip(x: Tensor, reference: Tensor) -> float:
    """Mean LDR-FLIP of displayed images (1, 3, H, W)."""
    return float(flip_map(*(image[0].permute(1, 2, 0).numpy() for image in (x, reference))).mean(dtype=np.float64))


def flip_floor(c: Comparison) -> float:
    """FLIP of the mean of the halves and one of them, which differ by (A - B) / 2."""
    a, b = c.shown_halves.split(1)
    return flip((a + b) / 2, a)


def mse_unbiased(c: Comparison) -> float:
    """E[(x - A)(x - B)] = E[(x - truth)²] of exposed linear radiance, for independent halves A and B; signed."""
    x = c.exposure * c.output
    a, b = c.exposure * c.halves
    return float(((x - a) * (x - b)).mean())


def mse_unbiased_error(c: Comparison) -> float:
    """Its standard error for a perfect image, at most, if noise is Gaussian and pixels are independent.

    With D = A - B, E|D|^4 >= 12 tr(S²) for the covariance S of a half's three channels, and tr(S²) / 9 is the variance
    of the mean of a pixel's three products.
    """
    variance = (2 * c.noise).square().sum(dim=0).square() / 12 / 9
    return variance.sum().sqrt().item() / variance.numel()


def smape(c: Comparison) -> float:
    x, r = (c.exposure * image for image in (c.output, c.reference))
    return float(((x - r).abs() / (x.abs() + r.abs() + EPSILON)).mean())


def smape_floor(c: Comparison) -> float:
    reference = c.exposure * c.reference[0]
    return float((c.noise.abs() / (2 * reference.abs() + EPSILON)).mean())


def relative_mse(c: Comparison) -> float:
    x, r = (c.exposure * image for image in (c.output, c.reference))
    return float(((x - r).square() / (r.square() + EPSILON)).mean())


def relative_mse_floor(c: Comparison) -> float:
    reference = c.exposure * c.reference[0]
    return float((c.noise.square() / (reference.square() + EPSILON)).mean())


def temporal_error(c: Comparison) -> float | None:
    """How far the change of luminance is off the reference's, from the second frame on."""
    return None if c.change is None else float((c.change.output - c.change.reference).abs().mean())


def temporal_error_floor(c: Comparison) -> float | None:
    """Half the temporal error between the halves."""
    if c.change is None:
        return None
    a, b = c.change.halves
    return float((a - b).abs().mean()) / 2


def flicker(c: Comparison) -> float | None:
    """Change of luminance where nothing moves in the clip (Schied et al. 2017, §5.4)."""
    return float(c.change.output.abs().mean()) if c.change and c.still else None


def where_disoccluded(c: Comparison, error: Tensor) -> float | None:
    """The mean of `error` (1, 3, H, W) on disoccluded pixels; None without any."""
    if c.disoccluded is None or not c.disoccluded.any():
        return None
    return error.mean(dim=1, keepdim=True)[c.disoccluded].mean().item()


METRICS = {
    "rmse": Metric(
        "RMSE",
        "{:.4f}",
        of=lambda c: math.sqrt(c.mse),
        floor=lambda c: math.sqrt(c.noise_mse),
    ),
    "psnr": Metric(
        "PSNR dB",
        "{:.2f}",
        more_is_better=True,
        of=lambda c: psnr(c.mse),
        floor=lambda c: psnr(c.noise_mse),
        edge=lambda floor: floor - 10 * math.log10(2),
    ),
    "ssim": Metric(
        "SSIM",
        "{:.4f}",
        more_is_better=True,
        of=lambda c: ssim(c.shown, c.shown_reference),
        floor=lambda c: ssim_floor(*c.shown_halves.split(1)),
        edge=lambda floor: 1 - twice(1 - floor),
    ),
    "flip": Metric(
        "FLIP",
        "{:.4f}",
        of=lambda c: flip(c.shown, c.shown_reference),
        floor=flip_floor,
    ),
    "mse_unbiased": Metric(
        "unbiased MSE",
        "{:.2e}",
        of=mse_unbiased,
        floor=mse_unbiased_error,
        edge=twice,
        floor_is_error=True,
    ),
    "temporal_error": Metric(
        "temporal error",
        "{:.4f}",
        of=temporal_error,
        floor=temporal_error_floor,
    ),
    "disocclusion_l1": Metric(
        "disocclusion L1",
        "{:.4f}",
        of=lambda c: where_disoccluded(c, (c.shown - c.shown_reference).abs()),
        floor=lambda c: where_disoccluded(c, c.shown_noise.abs()),
    ),
    "flicker": Metric(
        "flicker",
        "{:.4f}",
        of=flicker,
        floor=None,
    ),
    "l1": Metric(
        "L1",
        "{:.4f}",
        of=lambda c: (c.shown - c.shown_reference).abs().mean().item(),
        floor=lambda c: c.shown_noise.abs().mean().item(),
    ),
    "mse": Metric(
        "MSE",
        "{:.2e}",
        of=lambda c: c.mse,
        floor=lambda c: c.noise_mse,
        edge=twice,
    ),
    "smape": Metric(
        "SMAPE",
        "{:.4f}",
        of=smape,
        floor=smape_floor,
    ),
    "rel_mse": Metric(
        "relative MSE",
        "{:.2e}",
        of=relative_mse,
        floor=relative_mse_floor,
        edge=twice,
    ),
}


def measure(comparison: Comparison) -> Values:
    """All metrics of one frame."""
    return {name: metric.of(comparison) for name, metric in METRICS.items()}


def noise_floors(comparison: Comparison) -> Values:
    """The noise floors of all metrics that have one; the comparison's output does not enter."""
    return {name: metric.floor(comparison) for name, metric in METRICS.items() if metric.floor}


def within_floor(metric: str, value: float | None, floor: float | None) -> bool:
    """Whether a value says no more than that the image is at least as close to the truth as the reference is.

    Noise of the reference and error of the image add up: as variances, so up to twice the floor for squared errors and
    for what SSIM lacks of 1, half of it for PSNR, and the square root of two times it for absolute ones. An unbiased
    MSE is within two standard errors of 0.
    """
    if value is None or floor is None or metric not in METRICS:
        return False
    edge = METRICS[metric].edge(floor)
    return value >= edge if METRICS[metric].more_is_better else abs(value) <= edge
