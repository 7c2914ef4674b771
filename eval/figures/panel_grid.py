"""Grids of captioned images: one column per subject, one row per frame."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from plotting import DPI, TWO_LINE_CAPTION, Figure, enlargement, plt

# The longer side of an image, in pixels.
SMALLEST_IMAGE = 192
LARGEST_IMAGE = 480

COLOUR_BAR = 0.7  # inches beside an image


class Panel(NamedTuple):
    """A captioned image: (H, W, 3) in [0, 1], or numbers (H, W), coloured from `low` to `high`."""

    image: NDArray[np.floating]
    caption: str
    low: float = 0.0
    high: float = 1.0


Column = list[Panel]


def draw_grid(columns: Sequence[Column], row_names: Sequence[str]) -> Figure:
    """Panels of one size, those of numbers with colour bars; a row name for each panel of a column."""
    height, width = columns[0][0].image.shape[:2]
    zoom = min(LARGEST_IMAGE / max(height, width), enlargement(height, width, SMALLEST_IMAGE)) / DPI
    has_bars = any(column[0].image.ndim == 2 for column in columns)
    size = (
        len(columns) * (width * zoom + COLOUR_BAR * has_bars) + TWO_LINE_CAPTION,
        len(row_names) * (height * zoom + TWO_LINE_CAPTION),
    )
    figure, axes = plt.subplots(
        len(row_names), len(columns), figsize=size, dpi=DPI, squeeze=False, layout="constrained"
    )
    panels = [panel for column in columns for panel in column]
    for axis, panel in zip(axes.T.flat, panels, strict=True):
        drawn = axis.imshow(panel.image, cmap="viridis", vmin=panel.low, vmax=panel.high)
        axis.set(xticks=[], yticks=[])
        axis.set_title(panel.caption, fontsize=8, pad=2)
        if panel.image.ndim == 2:
            figure.colorbar(drawn, ax=axis, fraction=0.05, pad=0.02).ax.tick_params(labelsize=7)
    margin = TWO_LINE_CAPTION / 2 / size[0]
    figure.get_layout_engine().set(rect=(margin, 0, 1 - margin, 1))  # type: ignore
    for axis, name in zip(axes[:, 0], row_names, strict=True):
        axis.set_ylabel(name, fontsize=8)
    return figure
