"""Images of one frame side by side, to compare denoisers by eye."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from plotting import DPI, TWO_LINE_CAPTION, enlargement, plt, save_figure


def save_strip(
    path: Path, images: Mapping[str, NDArray[np.uint8]], errors: Mapping[str, Mapping[str, float | None]]
) -> None:
    """Write a PNG of images (H, W, 3) side by side, each captioned with its name and its RMSE and SSIM in `errors`."""
    height, width = next(iter(images.values())).shape[:2]
    zoom = enlargement(height, width) / DPI
    size = (len(images) * width * zoom, height * zoom + TWO_LINE_CAPTION)
    figure, axes = plt.subplots(1, len(images), figsize=size, dpi=DPI, squeeze=False)
    for axis, (name, image) in zip(axes[0], images.items(), strict=True):
        axis.imshow(image, interpolation="nearest")
        axis.set_axis_off()
        measured = {key: errors.get(name, {}).get(key) for key in ("rmse", "ssim")}
        caption = [f"{key.upper()} {value:.3f}" for key, value in measured.items() if value is not None]
        axis.set_title("\n".join([name, "  ".join(caption)]), fontsize=8, pad=2)
    figure.subplots_adjust(left=0, right=1, bottom=0, top=1 - TWO_LINE_CAPTION / size[1], wspace=0.01)
    save_figure(path, figure)
