"""Metrics of one frame (design §7): display space, linear radiance, and change over time."""

import math
from typing import NamedTuple

import flip_evaluator
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from datasets.frame import disoccluded
from datasets.tonemap import display, psnr
from eval.ssim import ssim
from models.operators import finite, image_luminance

EPSILON = 0.01


class Metric(NamedTuple):
    """How a metric is shown."""

    title: str
    form: str  # of its numbers
    more_is_better: bool = False


METRICS = {
    "rmse": Metric("RMSE", "{:.4f}"),
    "psnr": Metric("PSNR dB", "{:.2f}", more_is_better=True),
    "ssim": Metric("SSIM", "{:.4f}", more_is_better=True),
    "flip": Metric("FLIP", "{:.4f}"),
    "mse_unbiased": Metric("unbiased MSE", "{:.2e}"),
    "temporal_error": Metric("temporal error", "{:.4f}"),
    "disocclusion_l1": Metric("disocclusion L1", "{:.4f}"),
    "flicker": Metric("flicker", "{:.4f}"),
    "l1": Metric("L1", "{:.4f}"),
    "mse": Metric("MSE", "{:.2e}"),
    "smape": Metric("SMAPE", "{:.4f}"),
    "rel_mse": Metric("relative MSE", "{:.2e}"),
}


def flip_map(x: NDArray[np.floating], reference: NDArray[np.floating]) -> NDArray[np.float32]:
    """LDR-FLIP (H, W) in [0, 1] (Andersson et al. 2020) of displayed images (H, W, 3), at its default distance."""
    images = (np.ascontiguousarray(image, dtype=np.float32) for image in (reference, x))
    errors: NDArray[np.float32] = flip_evaluator.evaluate(*images, "LDR", applyMagma=False)[0]
    return errors.reshape(x.shape[:2])


def flip(x: Tensor, reference: Tensor) -> float:
    """Mean LDR-FLIP of displayed images (1, 3, H, W)."""
    return float(flip_map(*(image[0].permute(1, 2, 0).numpy() for image in (x, reference))).mean(dtype=np.float64))


def image_metrics(output: Tensor, halves: Tensor, exposure: float) -> dict[str, float | None]:
    """Metrics of one frame.

    Args:
        output: radiance (1, 3, H, W). A pixel that is not finite counts as 0.
        halves: the two independent halves (2, 3, H, W) of the reference radiance.
        exposure: the clip's.
    """
    output, halves = finite(output).double(), halves.double()
    reference = halves.mean(dim=0, keepdim=True)
    shown, truth = display(output, exposure), display(reference, exposure)
    mse = (shown - truth).square().mean().item()
    x, r, (a, b) = exposure * output, exposure * reference, exposure * halves
    return {
        "mse": mse,
        "rmse": math.sqrt(mse),
        "l1": (shown - truth).abs().mean().item(),
        "psnr": psnr(mse),
        "ssim": ssim(shown, truth),
        "flip": flip(shown, truth),
        "mse_unbiased": ((x - a) * (x - b)).mean().item(),
        "smape": ((x - r).abs() / (x.abs() + r.abs() + EPSILON)).mean().item(),
        "rel_mse": ((x - r).square() / (r.square() + EPSILON)).mean().item(),
    }


class TemporalMetrics:
    """Change from frame to frame of one denoiser's display luminance. Feed every frame in order."""

    def __init__(self) -> None:
        self.before: tuple[Tensor, Tensor, Tensor] | None = None

    def update(self, output: Tensor, halves: Tensor, exposure: float, still: bool) -> dict[str, float | None]:
        """`temporal_error`, its floor, and `flicker` where nothing moves in the clip; None on the first frame.

        The floor is half the temporal error between the two reference halves: what the reference's own noise adds.
        """
        halves = halves.double()
        images = (finite(output).double(), halves.mean(dim=0, keepdim=True), halves)
        y, reference, ab = (image_luminance(display(image, exposure)) for image in images)
        before, self.before = self.before, (y, reference, ab)
        if before is None:
            return {"temporal_error": None, "temporal_error_floor": None, "flicker": None}
        change, reference_change, ab_change = y - before[0], reference - before[1], ab - before[2]
        return {
            "temporal_error": (change - reference_change).abs().mean().item(),
            "temporal_error_floor": (ab_change[0] - ab_change[1]).abs().mean().item() / 2,
            "flicker": change.abs().mean().item() if still else None,
        }


def disocclusion_l1(
    output: Tensor, halves: Tensor, exposure: float, motion: Tensor, dual_motion: Tensor
) -> float | None:
    """Display L1 on disoccluded pixels; None without any."""
    hidden = disoccluded(motion, dual_motion)
    if not hidden.any():
        return None
    reference = halves.double().mean(dim=0, keepdim=True)
    error = (display(finite(output).double(), exposure) - display(reference, exposure)).abs()
    return error.mean(dim=1, keepdim=True)[hidden].mean().item()
