"""The metrics, each a row of METRICS with its noise floor. docs/evaluation.md defines them.

A noise floor is the score of the true image against the noisy reference. The reference is the mean of two independent
sample buffers A and B with errors a and b: its error (a + b) / 2 and (A - B) / 2 = (a - b) / 2 have the same variance.
So floors of squared errors are exact in expectation, and floors of absolute errors where noise is symmetric.
"""

import math
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass

import flip_evaluator
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from datasets.frame import to_image
from datasets.tonemap import psnr
from eval.comparison import Comparison, Luminances
from models.operators import sampling_grid

EPSILON = 0.01
FLICKER_BLOCK = 16  # px
# Of SSIM:
WINDOW = 11  # px
SIGMA = 1.5  # px
C1 = 0.01**2  # for images in [0, 1]
C2 = 0.03**2

Values = dict[str, float | None]  # by metric; None where undefined


def twice(floor: float) -> float:
    """Squared errors of image and reference add up."""
    return 2 * floor


def root_two_times(floor: float) -> float:
    """The squares of absolute errors add up."""
    return math.sqrt(2) * floor


def three_decibels_below(floor: float) -> float:
    """Those of a PSNR add up as well."""
    return floor - 10 * math.log10(2)


@dataclass(frozen=True)
class Metric:
    title: str  # its heading in tables
    form: str  # the format of its values
    more_is_better: bool = False
    _: KW_ONLY
    of: Callable[[Comparison], float | None]  # its value for a frame; None where it is undefined
    # the noise floor of a frame; None where noise of the reference has no effect
    floor: Callable[[Comparison], float | None] | None
    # from the floor, the value at which noise of the reference is as large as the image's own error
    edge: Callable[[float], float] = root_two_times
    floor_is_error: bool = False  # the floor is a standard error around 0, because noise does not bias the metric


def local_mean(images: Tensor) -> Tensor:
    """Gaussian-weighted means (B, 3, H - 10, W - 10) of images (B, 3, H, W) over all windows inside the image."""
    x = torch.arange(WINDOW, dtype=images.dtype) - WINDOW // 2
    weights = torch.softmax(-(x**2) / (2 * SIGMA**2), dim=0)
    height, width = (side - WINDOW + 1 for side in images.shape[-2:])
    zero = torch.zeros((), dtype=images.dtype)
    rows = sum((weight * images[..., i : height + i, :] for i, weight in enumerate(weights)), zero)
    return sum((weight * rows[..., i : width + i] for i, weight in enumerate(weights)), zero)


def ssim(x: Tensor, y: Tensor) -> float | None:
    """SSIM (Wang et al. 2004), the mean over windows and RGB of displayed images (B, 3, H, W); None if too small."""
    if min(x.shape[-2:]) < WINDOW:
        return None
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = (local_mean(image) for image in (x, y, x * x, y * y, x * y))
    variances = mean_xx - mean_x**2 + mean_yy - mean_y**2
    covariance = mean_xy - mean_x * mean_y
    brightness = (2 * mean_x * mean_y + C1) / (mean_x**2 + mean_y**2 + C1)
    return float((brightness * (2 * covariance + C2) / (variances + C2)).mean())


def ssim_floor(a: Tensor, b: Tensor) -> float | None:
    """SSIM of the truth and the mean of two displayed sample buffers (1, 3, H, W).

    None for images smaller than a window. The covariance of independent buffers is the variance of the truth, from
    which SSIM follows with the variance of the noise. SSIM between the buffers, or of one of them and their mean, would
    count noise as structure.
    """
    if min(a.shape[-2:]) < WINDOW:
        return None
    mean_a = local_mean(a)
    mean_b = local_mean(b)
    structure = (local_mean(a * b) - mean_a * mean_b).clamp(min=0)
    brightness = mean_a * mean_b
    shift = ((mean_a - mean_b) / 2).square()
    spread = local_mean(((a - b) / 2).square()) - shift
    similar = (2 * structure + C2) / (2 * structure + spread + C2)
    return float((similar * (2 * brightness + C1) / (2 * brightness + shift + C1)).mean())


def flip_map(x: NDArray[np.floating], reference: NDArray[np.floating]) -> NDArray[np.float32]:
    """LDR-FLIP (H, W) in [0, 1] (Andersson et al. 2020) of displayed images (H, W, 3), at its default distance."""
    images = (np.ascontiguousarray(image, dtype=np.float32) for image in (reference, x))
    return flip_evaluator.evaluate(*images, "LDR", applyMagma=False)[0].reshape(x.shape[:2])


def flip(x: Tensor, reference: Tensor) -> float:
    """Mean LDR-FLIP of displayed images (1, 3, H, W)."""
    return float(flip_map(*map(to_image, (x, reference))).mean(dtype=np.float64))


def flip_floor(c: Comparison) -> float:
    """FLIP between the mean of the buffers and one of them, which differ by (A - B) / 2."""
    a, b = c.displayed_buffers.split(1)
    return flip((a + b) / 2, a)


def mse_unbiased(c: Comparison) -> float | None:
    """E[(x - A)(x - B)] = E[(x - truth)²] of exposed linear radiance, for independent buffers A and B; signed."""
    if c.one_reference:
        return None
    x = c.exposure * c.output
    a, b = c.exposure * c.buffers
    return float(((x - a) * (x - b)).mean())


def mse_unbiased_error(c: Comparison) -> float:
    """An upper bound of its standard error for a perfect image, with Gaussian noise and independent pixels.

    With D = A - B, E|D|^4 >= 12 tr(S²) for the covariance S of a buffer's three channels, and tr(S²) / 9 is the
    variance of the mean of a pixel's three products.
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
    """Mean absolute difference between the change of luminance and the reference's; None on the first frame."""
    return None if c.change is None else float((c.change.output - c.change.reference).abs().mean())


def temporal_error_floor(c: Comparison) -> float | None:
    """Half the temporal error between the buffers."""
    if c.change is None or c.one_reference:
        return None
    a, b = c.change.buffers.split(1)
    return float((a - b).abs().mean()) / 2


def temporal_psnr(error: Tensor, before: Tensor | None) -> float | None:
    """tPSNR, the PSNR of the change of a displayed error (Bálint et al. 2023, Noisebase); None on the first frame."""
    return None if before is None else psnr(float((error - before).square().mean()))


def mean_block_change(c: Comparison, error_of: Callable[[Luminances], Tensor]) -> float | None:
    """Mean absolute change of an error (1, 1, H, W) of luminances, in means over blocks of 16 x 16 pixels.

    The error of the previous frame is fetched along the motion, bilinearly: what stays on a surface does not count.
    Pixels that the previous frame did not show are left out, and blocks without any other; None where none is left.
    """
    if c.before is None or c.motion is None:
        return None
    grid = sampling_grid(c.motion.double())
    seen = (grid.abs() <= 1).all(dim=-1)[:, None]
    if c.disoccluded is not None:
        seen = seen & ~c.disoccluded
    before = F.grid_sample(error_of(c.before.luminances), grid, padding_mode="border", align_corners=False)
    change = (error_of(c.luminances) - before) * seen
    total, share = (F.avg_pool2d(image.double(), FLICKER_BLOCK, ceil_mode=True) for image in (change, seen))
    return float((total / share)[share > 0].abs().mean()) if seen.any() else None


def block_flicker(c: Comparison) -> float | None:
    """Blotches that come and go: see mean_block_change."""
    return mean_block_change(c, lambda luminances: luminances.output - luminances.reference)


def block_flicker_floor(c: Comparison) -> float | None:
    """Half that of the difference between the buffers."""
    value = mean_block_change(c, lambda luminances: luminances.buffers[:1] - luminances.buffers[1:])
    return None if value is None else value / 2


def flicker(c: Comparison) -> float | None:
    """Mean absolute change of luminance in clips where nothing moves (Schied et al. 2017, §5.4)."""
    return float(c.change.output.abs().mean()) if c.change and c.still else None


def energy(c: Comparison) -> float | None:
    """Mean radiance over that of the reference, less 1: convex filters keep it, others lose a few per cent."""
    mean = float(c.reference.mean())
    return float(c.output.mean()) / mean - 1 if mean > 0 else None


def energy_error(c: Comparison) -> float | None:
    """Its standard error for a perfect image with independent pixels, whose channels share the noise of their paths."""
    mean = float((c.exposure * c.reference).mean())
    return float(c.noise.sum(dim=0).square().sum().sqrt()) / c.noise.numel() / mean if mean > 0 else None


def gradient_product(x: Tensor, y: Tensor) -> float:
    """The sum of products of the gradients, differences of adjacent pixels, of two images (1, 1, H, W)."""
    return sum(float((x.diff(dim=dim) * y.diff(dim=dim)).sum()) for dim in (-1, -2))


def detail(c: Comparison) -> float | None:
    """The share of the truth's gradients in displayed luminance that the image has, noise taken off: Σ ∇x ∇r / Σ ∇A ∇B.

    Gradients of noise, in image and reference, are uncorrelated with those of the truth.
    """
    if c.one_reference:
        return None
    output, reference, buffers = c.luminances
    truth = gradient_product(*buffers.split(1))
    return gradient_product(output, reference) / truth if truth > 0 else None


def where_disoccluded(c: Comparison, error: Tensor) -> float | None:
    """The mean of `error` (1, 3, H, W) on disoccluded pixels; None without any."""
    if c.disoccluded is None or not c.disoccluded.any():
        return None
    return error.mean(dim=1, keepdim=True)[c.disoccluded].mean().item()


METRICS = {
    "rmse": Metric("RMSE", "{:.4f}", of=lambda c: math.sqrt(c.mse), floor=lambda c: math.sqrt(c.noise_mse)),
    "psnr": Metric(
        "PSNR dB",
        "{:.2f}",
        more_is_better=True,
        of=lambda c: psnr(c.mse),
        floor=lambda c: psnr(c.noise_mse),
        edge=three_decibels_below,
    ),
    "ssim": Metric(
        "SSIM",
        "{:.4f}",
        more_is_better=True,
        of=lambda c: ssim(c.displayed, c.displayed_reference),
        floor=lambda c: ssim_floor(*c.displayed_buffers.split(1)),
        edge=lambda floor: 1 - twice(1 - floor),
    ),
    "flip": Metric("FLIP", "{:.4f}", of=lambda c: flip(c.displayed, c.displayed_reference), floor=flip_floor),
    "mse_unbiased": Metric(
        "unbiased MSE", "{:.2e}", of=mse_unbiased, floor=mse_unbiased_error, edge=twice, floor_is_error=True
    ),
    "temporal_error": Metric("temporal error", "{:.4f}", of=temporal_error, floor=temporal_error_floor),
    "tpsnr": Metric(
        "tPSNR dB",
        "{:.2f}",
        more_is_better=True,
        of=lambda c: temporal_psnr(c.error, c.before and c.before.error),
        floor=lambda c: temporal_psnr(c.displayed_noise, c.displayed_noise_before),
        edge=three_decibels_below,
    ),
    "disocclusion_l1": Metric(
        "disocclusion L1",
        "{:.4f}",
        of=lambda c: where_disoccluded(c, (c.displayed - c.displayed_reference).abs()),
        floor=lambda c: where_disoccluded(c, c.displayed_noise.abs()),
    ),
    "energy": Metric("energy", "{:+.1%}", of=energy, floor=energy_error, edge=twice, floor_is_error=True),
    "detail": Metric("detail", "{:.3f}", more_is_better=True, of=detail, floor=None),
    "block_flicker": Metric("block flicker", "{:.4f}", of=block_flicker, floor=block_flicker_floor),
    "flicker": Metric("flicker", "{:.4f}", of=flicker, floor=None),
    "l1": Metric(
        "L1",
        "{:.4f}",
        of=lambda c: (c.displayed - c.displayed_reference).abs().mean().item(),
        floor=lambda c: c.displayed_noise.abs().mean().item(),
    ),
    "mse": Metric("MSE", "{:.2e}", of=lambda c: c.mse, floor=lambda c: c.noise_mse, edge=twice),
    "smape": Metric("SMAPE", "{:.4f}", of=smape, floor=smape_floor),
    "rel_mse": Metric("relative MSE", "{:.2e}", of=relative_mse, floor=relative_mse_floor, edge=twice),
}


def measure(comparison: Comparison) -> Values:
    return {name: metric.of(comparison) for name, metric in METRICS.items()}


def noise_floors(comparison: Comparison) -> Values:
    """The noise floors of all metrics that have one; they do not depend on the comparison's output."""
    floors = {name: metric.floor for name, metric in METRICS.items() if metric.floor}
    return {name: None if comparison.one_reference else floor(comparison) for name, floor in floors.items()}


def within_floor(metric: str, value: float | None, floor: float | None) -> bool:
    """Whether the image is at least as close to the truth as the reference is, as far as the value can tell.

    Variances of the reference's noise and of the image's error add up. So the limit is twice the floor for squared
    errors and 1 - SSIM, √2 times the floor for absolute errors, 3 dB below it for PSNR, and two standard errors from 0
    for the unbiased MSE.
    """
    if value is None or floor is None or metric not in METRICS:
        return False
    edge = METRICS[metric].edge(floor)
    return value >= edge if METRICS[metric].more_is_better else abs(value) <= edge


def means(frames: list[Values]) -> Values:
    """Arithmetic means over the frames where a metric is defined, None where it never is."""
    names = dict.fromkeys(name for row in frames for name in row)
    columns = {name: [row[name] for row in frames if row.get(name) is not None] for name in names}
    return {name: float(np.mean(values)) if values else None for name, values in columns.items()}  # type: ignore[arg-type]


def mean_floor(frames: list[Values]) -> Values:
    """Noise floors of means over frames with independent noise: the squares of standard errors add up."""
    floors = means(frames)
    for name, metric in METRICS.items():
        errors = [error for row in frames if (error := row.get(name)) is not None]
        if metric.floor_is_error and errors:
            floors[name] = float(np.linalg.norm(errors) / len(errors))
    return floors
