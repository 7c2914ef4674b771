"""Which files make which frames: patterns become a sequence, in the order of the frames' numbers."""

import glob
import hashlib
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from denoise.layers import COLOUR
from errors import BadInput

FRAME_NUMBER = re.compile(r"(?:(?<![^._])-)?\d+")  # in the name of a file: a minus between words is a dash


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame: its number, and a path for each pass. "colour" may hold other layers too."""

    number: int
    passes: dict[str, Path]

    @property
    def name(self) -> str:
        """The name of the output file: that of the colour file."""
        return self.passes[COLOUR].name


def files_of(patterns: Sequence[str]) -> list[Path]:
    """All files that match patterns such as 'frames/*.exr' or plain paths. Raises BadInput for a pattern without."""
    paths: list[str] = []
    for pattern in patterns:
        matching = [pattern] if Path(pattern).is_file() else glob.glob(pattern)
        if not matching:
            raise BadInput(f"no file matches '{pattern}'")
        paths += matching
    return [Path(name) for name in sorted(dict.fromkeys(paths))]


def numbered(paths: Sequence[Path]) -> dict[int, Path]:
    """Files by number: the last in their names that differs between all of them. Raises BadInput where none does."""
    runs = [FRAME_NUMBER.findall(path.stem) for path in paths]
    if len(paths) == 1:
        return {int(runs[0][-1]) if runs[0] else 0: paths[0]}
    for place in range(1, min(map(len, runs)) + 1):
        numbers = [int(run[-place]) for run in runs]
        if len(set(numbers)) == len(numbers):
            return dict(sorted(zip(numbers, paths, strict=True)))
    raise BadInput(f"the names of {paths[0]} to {paths[-1]} have no frame numbers that differ: name one sequence")


def like(frames: Collection[int], files: dict[int, Path]) -> dict[int, Path]:
    """Files by number; a single file belongs to a single frame, whatever number its name has."""
    return dict(zip(frames, files.values(), strict=True)) if len(frames) == len(files) == 1 else files


def sequence_of(patterns: Mapping[str, Sequence[str]], numbers: str | None = None) -> list[FrameFiles]:
    """The frames of the patterns of all passes, by number; of "colour" all that there are within `numbers` "A-B".

    Raises BadInput where a pass lacks a frame, or no frame is left.
    """
    passes = {name: numbered(files_of(each)) for name, each in patterns.items()}
    passes = {name: like(passes[COLOUR], files) for name, files in passes.items()}
    first, last = frame_range(numbers)
    chosen = [number for number in passes[COLOUR] if first <= number <= last]
    if not chosen:
        available = list(passes[COLOUR])
        raise BadInput(f"there is no frame within --frames {numbers}: there are {available[0]} to {available[-1]}")
    for name, files in passes.items():
        if missing := [number for number in chosen if number not in files]:
            lacking = f"'{' '.join(patterns[name])}' ({name}) lacks frame {missing[0]}"
            raise BadInput(f"{lacking}: render it, or use --frames")
    return [FrameFiles(number, {name: files[number] for name, files in passes.items()}) for number in chosen]


def frame_range(text: str | None) -> tuple[int, int]:
    """(first, last) of "A-B" or "A"; all for None. Raises BadInput for any other text."""
    if text is None:
        return -(2**62), 2**62
    match = re.fullmatch(r"(-?\d+)(?:-(-?\d+))?", text)
    if not match:
        raise BadInput(f"'{text}' is not a range of frames such as 1-24")
    return int(match[1]), int(match[2] or match[1])


def gaps(frames: Sequence[FrameFiles]) -> list[int]:
    """The numbers of frames that come right after missing ones: no history leads there."""
    return [after.number for before, after in pairwise(frames) if after.number != before.number + 1]


def split_at_cuts(frames: Sequence[FrameFiles], resets: Sequence[int]) -> list[list[FrameFiles]]:
    """The frames, cut before the numbers `resets` and after missing ones. Raises BadInput for a number of no frame."""
    if unknown := set(resets) - {frame.number for frame in frames}:
        raise BadInput(f"--reset-at {min(unknown)}: there is no such frame")
    cuts = {*resets, *gaps(frames)}
    parts: list[list[FrameFiles]] = []
    for frame in frames:
        if not parts or frame.number in cuts:
            parts.append([])
        parts[-1].append(frame)
    return parts


def stamps_of(shot: Sequence[FrameFiles]) -> list[str]:
    """A text for each frame of a shot: another one if the size or time of one of its files, or of those before, is."""
    digest = hashlib.sha256()
    stamps = []
    for frame in shot:
        stats = [path.stat() for path in frame.passes.values()]
        digest.update(repr([(stat.st_size, stat.st_mtime_ns) for stat in stats]).encode())
        stamps.append(digest.hexdigest()[:16])
    return stamps
