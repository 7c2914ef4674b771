"""Figures on disk, whole or not at all."""

from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from files import replacing

matplotlib.use("Agg")
from matplotlib import pyplot as plt

__all__ = ["DPI", "plt", "save_figure"]

DPI = 100


def save_figure(path: Path, figure: Figure) -> None:
    """Write a PNG of DPI pixels an inch and close the figure."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)
    plt.close(figure)
