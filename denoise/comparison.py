"""How far denoised frames are from references of the same frames."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tabulate import tabulate
from torch import Tensor

from datasets.frame import to_tensor
from denoise.exr_image import ExrImage
from denoise.sequence import COLOUR, FrameFiles
from denoise.sources import find_sources
from errors import BadInput
from eval.comparison import Comparison
from eval.metrics import METRICS
from files import write_file

MEASURED = ("rmse", "psnr", "ssim")
FILE = "metrics.csv"


def compare(frames: Sequence[FrameFiles], references: Sequence[Path], out: Path, exposure: float) -> str:
    """Measure the frames on disk against references, as displayed at `exposure`; keep all in metrics.csv.

    Returns a table of the means. Raises BadInput where a reference is of another size.
    """
    rows = []
    for files, reference in zip(frames, references, strict=True):
        halves = radiance(reference).repeat(2, 1, 1, 1)  # of one reference, whose noise is not known
        denoised = radiance(out / files.name)
        if halves.shape[1:] != denoised.shape[1:]:
            raise BadInput(f"{reference} is of another size than {out / files.name}")
        comparison = Comparison(denoised, halves, exposure)
        rows.append([files.number, *(METRICS[name].of(comparison) for name in MEASURED)])
    text = io.StringIO(newline="")
    csv.writer(text).writerows([["frame", *MEASURED], *rows])
    write_file(out / FILE, text.getvalue().encode())
    columns = zip(*(row[1:] for row in rows), strict=True)
    means = [None if None in column else float(np.mean(column)) for column in columns]
    cells = [
        "-" if mean is None else METRICS[name].form.format(mean) for name, mean in zip(MEASURED, means, strict=True)
    ]
    return tabulate([cells], [f"mean {METRICS[name].title}" for name in MEASURED], disable_numparse=True)


def radiance(path: Path) -> Tensor:
    """The radiance (1, 3, H, W) of a finished image: its `Combined` rather than `Noisy Image`, finite."""
    image = ExrImage(path)
    channels = find_sources({COLOUR: image}, {}).target
    return torch.nan_to_num(to_tensor(image.stacked(channels)), nan=0.0, posinf=0.0, neginf=0.0)
