"""Figures on disk, complete or not at all, and the sizes of what is in them. All drawing packages are imported here.

Importing this module raises BadInput where the extra `report` is not installed.
"""

import base64
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.tonemap import to_8_bits
from errors import requires_extra
from files import replacing

with requires_extra("report"):
    import matplotlib

    matplotlib.use("Agg")
    # "X as X" marks what other modules import from here.
    from matplotlib import pyplot
    from matplotlib import ticker as ticker
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
    from PIL import Image as Image
    from PIL import ImageDraw as ImageDraw
    from PIL import ImageFont as ImageFont

plt = pyplot
DPI = 100
TWO_LINE_CAPTION = 0.45  # inches
SMALLEST_PANEL = 256  # px, the longer side of an image


def enlargement(height: int, width: int, smallest: int = SMALLEST_PANEL) -> int:
    """The integer factor that makes the longer side of an image at least `smallest` pixels."""
    return max(1, math.ceil(smallest / max(height, width)))


def data_uri(content: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def webp_uri(image: NDArray[np.floating], **options: Any) -> str:
    """A WebP, with Pillow's `options`, of an image (H, W, 3) or (H, W) in [0, 1]."""
    buffer = io.BytesIO()
    Image.fromarray(to_8_bits(image)).save(buffer, "WEBP", **options)
    return data_uri(buffer.getvalue(), "webp")


def save_figure(path: Path, figure: Figure) -> None:
    """Write a PNG of DPI pixels an inch and close the figure."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)
    plt.close(figure)
