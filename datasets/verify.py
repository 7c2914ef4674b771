"""Whether the files of a data set are as they were written."""

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from datasets.channels import CHANNELS
from datasets.clip import Clip, Dataset
from errors import BadInput


def find_problems(root: Path) -> list[str]:
    """Everything wrong with a data set, one line each. Raises BadInput where there is none at `root`."""
    progress = tqdm(Dataset(root).planned(), "verify", unit="clip", leave=False)
    return [problem for path in progress for problem in problems_of_clip(path)]


def problems_of_clip(path: Path) -> Iterator[str]:
    if not path.exists():
        yield f"{path} has not been rendered"
        return
    try:
        clip = Clip(path)
    except BadInput as error:
        yield str(error)
        return
    for name, entry in clip.channels.items():
        if name not in CHANNELS:
            yield f"{path}: clip.json has the unknown channel '{name}'"
        elif "file" in entry:
            try:
                clip.map(name)
            except BadInput as error:
                yield str(error)
                continue
            if f"{zlib.crc32(np.memmap(path / entry['file'], mode='r').data):08x}" != entry["crc32"]:
                yield f"{path / entry['file']} is damaged: its checksum is not {entry['crc32']}"
