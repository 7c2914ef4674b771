"""Whether the files of a data set are as they were written."""

import zlib
from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

from datasets.channels import CHANNELS
from datasets.clip import Clip, Dataset
from errors import BadInput

CHUNK_BYTES = 1 << 24


def find_problems(root: Path) -> list[str]:
    """Everything wrong with a data set, one line each. Raises BadInput where there is none at `root`."""
    progress = tqdm(Dataset(root).planned(), "verify", unit="clip", leave=False)
    return [problem for path in progress for problem in problems_of_clip(path)]


def problems_of_clip(path: Path) -> Iterator[str]:
    """Everything wrong with one clip, one line each, naming the file."""
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
            if file_crc32(path / entry["file"]) != entry["crc32"]:
                yield f"{path / entry['file']} is damaged: its checksum is not {entry['crc32']}"


def file_crc32(path: Path) -> str:
    """The checksum of a file, zlib's crc32, as 8 hex digits."""
    checksum = 0
    with path.open("rb") as file:
        while part := file.read(CHUNK_BYTES):
            checksum = zlib.crc32(part, checksum)
    return f"{checksum:08x}"
