"""How far denoised frames are from references of the same frames."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tabulate import tabulate

from datasets.frame import to_tensor
from denoise.exr_image import ExrImage
from denoise.layers import COLOUR
from denoise.sequence import FrameFiles
from denoise.sources import find_sources
from errors import BadInput
from eval.comparison import Comparison
from eval.metrics import METRICS
from files import write_csv

COMPARED_METRICS = ("rmse", "psnr", "ssim")


def compare(
    frames: Sequence[FrameFiles], references: Sequence[Path], out: Path, target: Sequence[str], exposure: float
) -> str:
    """Measure the `target` channels of frames on disk against references, as displayed, and write metrics.csv.

    Returns a table of the means. Raises BadInput where a reference is of another size.
    """
    rows = []
    for files, reference in zip(frames, references, strict=True):
        reference_pair = to_tensor(radiance(reference, target)).repeat(2, 1, 1, 1)  # of one: its noise is unknown
        denoised = to_tensor(radiance(out / files.name, target))
        if reference_pair.shape[1:] != denoised.shape[1:]:
            raise BadInput(f"{reference} is of another size than {out / files.name}")
        comparison = Comparison(denoised, reference_pair, exposure)
        rows.append([files.number, *(METRICS[name].of(comparison) for name in COMPARED_METRICS)])
    write_csv(out / "metrics.csv", ["frame", *COMPARED_METRICS], rows)
    columns = zip(COMPARED_METRICS, list(zip(*rows, strict=True))[1:], strict=True)
    cells = ["-" if None in column else METRICS[name].form.format(np.mean(column)) for name, column in columns]
    return tabulate([cells], [f"mean {METRICS[name].title}" for name in COMPARED_METRICS], disable_numparse=True)


def radiance(path: Path, target: Sequence[str]) -> NDArray[np.float32]:
    """The radiance (H, W, 3) of a finished image, finite: its `target` channels, or else those called like radiance."""
    image = ExrImage(path)
    channels = target if all(name in image.channels for name in target) else find_sources({COLOUR: image}, {}).target
    return np.nan_to_num(image.stacked(channels), nan=0.0, posinf=0.0, neginf=0.0)
