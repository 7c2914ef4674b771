"""Test sequences of Noisebase (Bálint et al. 2023): 1920 x 1080, a few samples per pixel, a reference per frame.

Format (https://github.com/balintio/noisebase, docs/formats/sample_test_v1.md): SEQUENCE/frameNNNN.zip, each a zarr
group. Samples are the last axis; radiance is coded as RGBE; matrices are for row vectors, clip space's y points up. Its
scripts leave out 28 rows at the top and at the bottom.
"""

import re
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.imported import Image, ImportedFrame, by_name, check_size, view_of_clip_space, write_dataset
from errors import BadInput, requires_extra

CROPPED_ROWS = 28  # rows
ARRAYS = ("color", "reference", "position", "motion", "normal", "diffuse")
FRAME = re.compile(r"frame(\d{4})\.zip")


def import_noisebase(source: Path, out: Path, samples: int) -> int:
    """Make a dataset of the sequences below `source`, with the first `samples` of each pixel. Returns how many.

    Raises BadInput, naming the file, where there is none, or one is missing, damaged, too small or of another size, or
    has fewer samples; and for no samples.
    """
    if samples < 1:
        raise BadInput(f"--spp {samples}: use one sample per pixel or more")
    folders = sorted({path.parent for path in source.glob("**/frame*.zip") if FRAME.fullmatch(path.name)})
    if not folders:
        raise BadInput(f"{source} has no sequence: each is a folder with frame0000.zip and so on")
    named = by_name(folders, [folder.name for folder in folders])
    clips = {name: frames_of(files_of(folder), samples) for name, folder in named.items()}
    return write_dataset(out, f"noisebase at {samples} spp", clips, samples)


def files_of(folder: Path) -> list[Path]:
    """The frames of a sequence in order. Raises BadInput where one is missing: motion leads to the frame before."""
    numbers = sorted(int(match[1]) for path in folder.iterdir() if (match := FRAME.fullmatch(path.name)))
    for before, number in pairwise(numbers):
        if number != before + 1:
            raise BadInput(f"{folder / f'frame{before + 1:04d}.zip'} is missing: get it, too")
    return [folder / f"frame{number:04d}.zip" for number in numbers]


def frames_of(files: Sequence[Path], samples: int) -> Iterator[ImportedFrame]:
    """The frames of a sequence. Surfaces are those of the first sample: the mean of several depths lies on none."""
    size: tuple[int, int] | None = None
    for path in tqdm(files, files[0].parent.name, unit="frame", leave=False):
        arrays = read_group(path)
        _, height, width, count = arrays["color"].shape
        size = size or (height, width)
        for name in ARRAYS:
            check_size(arrays[name].shape[1:3], size, path)
        if count < samples:
            raise BadInput(f"{path} has {count} samples per pixel, not {samples}")
        if height <= 2 * CROPPED_ROWS:
            raise BadInput(f"{path} has {height} rows: nothing is left without the {CROPPED_ROWS} at top and bottom")
        to_pixels = np.array([[width / 2, 0, width / 2], [0, -height / 2, height / 2 - CROPPED_ROWS], [0, 0, 1]])
        normal = image_of(arrays["normal"][..., 0])
        yield ImportedFrame(
            radiance=image_of(decoded(arrays["color"][..., :samples], arrays["exposure"]).mean(axis=-1)),
            reference=image_of(arrays["reference"]),
            albedo=image_of(arrays["diffuse"][..., :samples].mean(axis=-1, dtype=np.float32)),
            normal=normal,
            position=image_of(arrays["position"][..., 0]),
            surface=np.abs(normal).sum(axis=-1) > 0,
            view=view_of_clip_space(arrays["view_proj_mat"].astype(np.float64), to_pixels, path),
            moved=image_of(arrays["motion"][..., 0]),
        )


def image_of(array: NDArray[Any]) -> Image:
    """(C, H, W) as (H, W, C), without the rows that are left out."""
    return np.moveaxis(array[:, CROPPED_ROWS:-CROPPED_ROWS].astype(np.float32), 0, -1)


def read_group(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a frame. Raises BadInput where the file is damaged or lacks one."""
    with requires_extra("noisebase"):
        import zarr
    try:
        with zarr.storage.ZipStore(path, mode="r") as store:
            group = zarr.open_group(store, mode="r")
            return {name: np.asarray(group[name]) for name in (*ARRAYS, "exposure", "view_proj_mat")}
    except Exception as error:  # a damaged archive may fail in any way
        raise BadInput(f"{path} is damaged or incomplete ({error}): get it again") from None


def decoded(color: NDArray[np.uint8], exposure: NDArray[np.float32]) -> Image:
    """Radiance (3, H, W, S) of RGBE `color` (4, H, W, S): each mantissa / 255 times exp of the exponent.

    The exponent's 256 steps divide the range between the logarithms in `exposure` evenly.
    """
    low, high = (float(value) for value in exposure)
    exponent = low + (color[3].astype(np.float32) + 1) / 256 * (high - low)
    return color[:3].astype(np.float32) / 255 * np.exp(exponent)
