"""The data of Koskela et al. 2019 (BMFR): scenes of 60 frames at 1 spp, with first hits, cameras and references.

Layout (https://github.com/maZZZu/bmfr): SCENE/inputs/ has colorN.exr (irradiance: the albedo is left out),
referenceN.exr (radiance), albedoN.exr, shading_normalN.exr and world_positionN.exr, N from 0, and camera_matrices.h:
a 4 x 4 matrix per frame from the world to clip space, for row vectors. A pixel's row grows with clip space's y.
"""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR
from tqdm import tqdm

from datasets.exr import silenced
from datasets.imported import Image, ImportedFrame, by_name, check_size, view_of_clip_space, write_dataset
from errors import BadInput
from scenes.camera import Array

MATRICES = "camera_matrices.h"
PASSES = ("color", "reference", "albedo", "shading_normal", "world_position")
NUMBER = r"-?\d+\.?\d*(?:[eE][-+]?\d+)?f?"


def import_bmfr(source: Path, out: Path) -> int:
    """Make a dataset of the scenes below `source`. Returns how many clips were written.

    Raises BadInput, naming the file, where there is none, one is missing, damaged or of another size, or two have the
    same name.
    """
    folders = sorted(path.parent for path in source.glob(f"**/{MATRICES}"))
    if not folders:
        raise BadInput(f"{source} has no scene: each is a folder with {MATRICES} and color0.exr")
    names = [folder.parent.name if folder.name == "inputs" else folder.name for folder in folders]
    clips = {name: frames_of(folder) for name, folder in by_name(folders, names).items()}
    return write_dataset(out, "bmfr", clips, spp=1)


def frames_of(folder: Path) -> Iterator[ImportedFrame]:
    """The frames of a scene, as many as there are colours and matrices."""
    matrices = read_matrices(folder / MATRICES)
    count = sum((folder / f"color{index}.exr").exists() for index in range(len(matrices)))
    if not count:
        raise BadInput(f"{folder / 'color0.exr'} is missing")
    size = height, width = read_rgb(folder / "color0.exr").shape[:2]
    for index in tqdm(range(count), folder.parent.name, unit="frame", leave=False):
        files = [folder / f"{name}{index}.exr" for name in PASSES]
        images = [read_rgb(file) for file in files]
        for file, image in zip(files, images, strict=True):
            check_size(image.shape[:2], size, file)
        color, reference, albedo, normal, position = images
        surface = np.abs(normal).sum(axis=-1) > 0
        to_pixels = np.array([[width / 2, 0, width / 2], [0, height / 2, height / 2], [0, 0, 1]])
        view = view_of_clip_space(matrices[index], to_pixels, folder / MATRICES)
        yield ImportedFrame(color * albedo, reference, albedo, normal, position, surface, view)


def read_matrices(path: Path) -> Array:
    """The matrices (N, 4, 4) of all frames. Raises BadInput where the file has none."""
    text = path.read_bytes().decode("ascii", errors="replace")
    match = re.search(r"camera_matrices[^=]*=\s*\{(.*?)\}\s*;", text, re.DOTALL)
    without_comments = re.sub(r"//.*", "", match[1] if match else "")
    numbers = [float(number.rstrip("f")) for number in re.findall(NUMBER, without_comments)]
    if not numbers or len(numbers) % 16 or "\N{REPLACEMENT CHARACTER}" in without_comments:
        raise BadInput(f"{path} has no 4 x 4 matrices named camera_matrices: get the file again")
    return np.array(numbers).reshape(-1, 4, 4)


def read_rgb(path: Path) -> Image:
    """The three channels (H, W, 3) of an EXR file. Raises BadInput where it is missing or damaged."""
    if not path.exists():
        raise BadInput(f"{path} is missing")
    try:
        with silenced(), OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            planes = [np.array(channels[name].pixels, np.float32) for name in "RGB"]
    except (RuntimeError, ValueError, KeyError) as error:
        raise BadInput(f"{path} is damaged or has no R, G and B ({error}): get it again") from None
    return np.nan_to_num(np.stack(planes, axis=-1), posinf=0, neginf=0)
