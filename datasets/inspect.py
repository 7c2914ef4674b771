"""What is in a data set, and whether it is undamaged."""

import zlib
from pathlib import Path

from tabulate import tabulate
from tqdm import tqdm

from datasets.channels import CHANNELS
from datasets.clip import Clip, Dataset
from datasets.display import psnr
from datasets.files import read_json
from errors import BadInput

CHUNK = 1 << 24


def file_crc32(path: Path) -> str:
    checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK):
            checksum = zlib.crc32(chunk, checksum)
    return f"{checksum:08x}"


def check_clip(path: Path) -> list[str]:
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


def verify(root: Path) -> list[str]:
    """Everything wrong with a data set, one line each."""
    paths = Dataset(root).planned()
    return [problem for path in tqdm(paths, "verify", unit="clip", leave=False) for problem in check_clip(path)]


def size_of(path: Path) -> int:
    return sum(file.stat().st_size for file in path.rglob("*") if file.is_file())


def stored_as(entry: dict[str, object]) -> str:
    if "file" in entry:
        return str(entry["dtype"])
    return "value" if "value" in entry else "derived"


def info(root: Path) -> str:
    """Tables of clips (size, noise floor, render time) and of channels (storage, size)."""
    dataset = Dataset(root)
    rows: list[list[object]] = []
    sizes, storage = dict.fromkeys(CHANNELS, 0), {name: set[str]() for name in CHANNELS}
    for path in dataset.planned():
        label = str(path.relative_to(root))
        if not (path / "clip.json").exists():
            rows.append([label, "missing"])
            continue
        clip = Clip(path)
        for name, entry in clip.channels.items():
            storage[name].add(stored_as(entry))
            sizes[name] += (path / entry["file"]).stat().st_size if "file" in entry else 0
        seconds = sum(read_json(path / "timing.json").values())
        lost = sum(clip.facts["nonfinite"].values()) + sum(clip.facts["clamped"].values())
        rows.append(
            [
                *(label, clip.frames, f"{clip.height}x{clip.width}", clip.realisations, clip.facts["reference_spp"]),
                *(f"{psnr(clip.facts['floor_mse']):.1f}", f"{clip.exposure:.3g}", lost),
                *(f"{size_of(path) / 1e6:.1f}", f"{seconds:.1f}"),
            ]
        )
    head = ["clip", "frames", "size", "noisy", "reference spp", "floor dB", "exposure", "bad values", "MB", "seconds"]
    channels = [[n, ", ".join(sorted(storage[n])), f"{sizes[n] / 1e6:.1f}"] for n in CHANNELS if storage[n]]
    facts = dataset.facts
    title = f"{root}: profile {facts['profile']}, seed {facts['seed']}, {size_of(root) / 1e6:.1f} MB"
    tables = [tabulate(rows, head), tabulate(channels, ["channel", "stored as", "MB"], disable_numparse=True)]
    return "\n\n".join([title, *tables])
