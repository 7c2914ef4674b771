"""Structural similarity (Wang et al. 2004) and its noise floor."""

import torch
from torch import Tensor

WINDOW = 11  # px
SIGMA = 1.5  # px
C1 = 0.01**2  # for images in [0, 1]
C2 = 0.03**2


def local_mean(images: Tensor) -> Tensor:
    """Gaussian-weighted means (B, 3, H - 10, W - 10) of images (B, 3, H, W) over all windows inside the image."""
    x = torch.arange(WINDOW, dtype=images.dtype) - WINDOW // 2
    weights = torch.softmax(-(x**2) / (2 * SIGMA**2), dim=0)
    rows = sum(weight * images[..., i : images.shape[-2] - WINDOW + 1 + i, :] for i, weight in enumerate(weights))
    assert isinstance(rows, Tensor)
    columns = sum(weight * rows[..., i : rows.shape[-1] - WINDOW + 1 + i] for i, weight in enumerate(weights))
    assert isinstance(columns, Tensor)
    return columns


def ssim(x: Tensor, y: Tensor) -> float | None:
    """Mean over windows and RGB of displayed images (B, 3, H, W); None for images smaller than a window."""
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
