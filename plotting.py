"""Figures on disk, whole or not at all, and the sizes of what is in them."""

import math
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from files import replacing

matplotlib.use("Agg")
from matplotlib import pyplot as plt

__all__ = [
    "DPI",
    "SMALLEST_PANEL",
    "TWO_LINE_CAPTION",
    "enlargement",
    "plt",
    "save_figure",
]

DPI = 100
TWO_LINE_CAPTION = 0.45  # inches
SMALLEST_PANEL = 256  # px, the longer side of an image


def enlargement(height: int, width: int, smallest: int = SMALLEST_PANEL) -> int:
    """The whole factor that makes the longer side of an image at least `smallest` pixels."""
    return max(1, math.ceil(smallest / max(height, width)))


def save_figure(path: Path, figure: Figure) -> None:
    """Write a PNG of DPI pixels an inch and close the figure."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)
    plt.close(figure)
