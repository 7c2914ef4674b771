"""Whether the files of a data set are as they were written."""

import zlib
from pathlib import Path

from tqdm import tqdm

from datasets.channels import CHANNELS
from datasets.clip import Clip, Dataset
from errors import BadInput

BYTES_AT_ONCE = 1 << 24


def find_problems(root: Path) -> list[str]:
    """Everything wrong with a data set, one line each. Raises BadInput where there is none at `root`."""
    paths = Dataset(root).planned()
    progress = tqdm(paths, "verify", unit="clip", leave=False)
    return [problem for path in progress for problem in problems_of_clip(path)]


def problems_of_clip(path: Path) -> list[str]:
    """Everything wrong with one clip, one line each, naming the file."""
    if not path.exists():
        return [f"{path} has not been rendered"]
    try:
        clip = Clip(path)
    except BadInput as error:
        return [str(error)]
    problems = [f"{path}: clip.json has the unknown channel '{name}'" for name in clip.channels if name not in CHANNELS]
    for name, entry in clip.channels.items():
        if "file" not in entry or name not in CHANNELS:
            continue
        try:
            clip.map(name)
        except BadInput as error:
            problems.append(str(error))
            continue
        if file_crc32(path / entry["file"]) != entry["crc32"]:
            problems.append(f"{path / entry['file']} is damaged: its checksum is not {entry['crc32']}")
    return problems


def file_crc32(path: Path) -> str:
    """The checksum of a file, zlib's crc32, as 8 hex digits."""
    checksum = 0
    with path.open("rb") as file:
        while part := file.read(BYTES_AT_ONCE):
            checksum = zlib.crc32(part, checksum)
    return f"{checksum:08x}"
