"""A data set as the training toolkit of Intel Open Image Denoise reads it: one OpenEXR file a feature of an image.

Its rules (RenderKit/oidn, training/dataset.py and image.py): the images of a folder are GROUP_SAMPLES.FEATURE.exr. Of
each group, the last one in the order of their names as text is the target, and all others are noisy inputs. An input
needs all features that are trained with, the target its colour. Features are the first three channels of a file.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from datasets.card import CARD_FILE, card_of
from datasets.clip import Clip, Dataset
from datasets.exr import write_planes
from errors import BadInput
from files import read_json, write_json

SPLIT_FOLDERS = {"train": "train", "val": "valid", "test": "test"}  # as its options are called by default


def export_dataset(root: Path, out: Path) -> int:
    """Write all splits of a data set to `out`, or resume that. Returns the number of noisy images.

    Every noise realisation of a frame is a group of its own, SCENE-CLIP-FRAME-REALISATION: a group has one image for
    each number of samples. Files that are there are kept. The data set's card is put beside them.

    Raises BadInput where a clip is missing or damaged, or `out` contains something else.
    """
    dataset = Dataset(root)
    splits = [split for split, names in dataset.facts["splits"].items() if names]
    clips = [(split, clip) for split in splits for clip in dataset.clips(split)]
    claim_folder(out, dataset)
    for split, clip in tqdm(clips, "exr", unit="clip"):
        folder = out / SPLIT_FOLDERS[split]
        folder.mkdir(exist_ok=True)
        for frame in clip.judged:
            for realisation in range(clip.realisations):
                write_group(folder, clip, frame, realisation)
    return sum(len(clip.judged) * clip.realisations for _, clip in clips)


def claim_folder(out: Path, dataset: Dataset) -> None:
    """Put the data set's card into `out`. Raises BadInput where that has another data set, or something else."""
    card = card_of(dataset)
    out.mkdir(parents=True, exist_ok=True)
    if (out / CARD_FILE).exists():
        if read_json(out / CARD_FILE) != card:
            raise BadInput(f"{out} contains another data set than {dataset.path}: choose another folder or delete it")
    elif any(out.glob("[!.]*")):
        raise BadInput(f"{out} contains something else than a data set for OIDN: choose an empty or new folder")
    else:
        write_json(out / CARD_FILE, card)


def write_group(folder: Path, clip: Clip, frame: int, realisation: int) -> None:
    """Write the noisy image of one realisation with its features, and its reference, unless they exist."""
    group = f"{clip.scene}-{clip.name}-{frame:04d}-{realisation}"
    noisy = f"{group}_{clip.facts['noisy_spp']:04d}spp"
    images: dict[str, Callable[[], NDArray[np.generic]]] = {
        f"{noisy}.hdr": lambda: clip.noisy(frame, realisation),
        f"{group}_reference.hdr": lambda: clip.reference(frame).mean(axis=0),  # as text it comes after all numbers
    }
    for name in (noisy, f"{group}_reference"):  # the toolkit's option --clean_aux takes those of the reference
        images[f"{name}.alb"] = lambda: clip.read_blended("albedo", frame)
        images[f"{name}.nrm"] = lambda: clip.read_blended("normal", frame)
    for name, read in images.items():
        path = folder / f"{name}.exr"
        if not path.exists():
            image = read()
            write_planes(path, {c: np.ascontiguousarray(image[..., i]) for i, c in enumerate("RGB")}, {})
