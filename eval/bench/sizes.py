"""Sizes and numbers of threads as given on the command line, and the folder of results."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch

from errors import BadInput

Size = tuple[int, int]  # height, width


def parse_size(text: str) -> Size:
    """(height, width) in pixels of "1280x720". Raises BadInput for other text."""
    match = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if not match:
        raise BadInput(f"'{text}' is not a size such as 1280x720")
    return int(match[2]), int(match[1])


def size_name(size: Size) -> str:
    """The inverse of parse_size: "1280x720" of (720, 1280)."""
    height, width = size
    return f"{width}x{height}"


def thread_counts(threads: Sequence[int]) -> list[int]:
    """The numbers of threads to measure with, rising; by default all of PyTorch's. Raises BadInput below 1."""
    for count in threads:
        if count < 1:
            raise BadInput(f"{count} threads cannot work: name at least 1")
    return sorted({*threads} or {torch.get_num_threads()})


def threads_or_all(threads: int | None) -> int:
    """`threads`, by default all of PyTorch's. Raises BadInput below 1."""
    return thread_counts(() if threads is None else (threads,))[-1]


def bench_folder(runs: Path) -> Path:
    """RUNS/bench, which is created if missing."""
    folder = runs / "bench"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
