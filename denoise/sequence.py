"""Which files make which frames: patterns become a sequence, in the order of the frames' numbers."""

import glob
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from errors import BadInput

COLOUR = "colour"  # the pass that a frame cannot do without


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame: its number, and a path for each pass. "colour" may hold other layers too."""

    number: int
    passes: dict[str, Path]

    @property
    def name(self) -> str:
        """What the output file is called: as the colour file is."""
        return self.passes[COLOUR].name


def files_of(patterns: Sequence[str]) -> list[Path]:
    """All files that patterns such as 'frames/*.exr' or plain paths mean. Raises BadInput where there are none."""
    found: list[str] = []
    for pattern in patterns:
        matching = [pattern] if Path(pattern).is_file() else glob.glob(pattern)
        if not matching:
            raise BadInput(f"no file matches '{pattern}'")
        found += matching
    return [Path(name) for name in sorted(dict.fromkeys(found))]


def numbered(paths: Sequence[Path]) -> dict[int, Path]:
    """Files by frame number: of the numbers in their names the last that tells them apart.

    Raises BadInput where none does.
    """
    runs = [re.findall(r"\d+", path.stem) for path in paths]
    if len(paths) == 1:
        return {int(runs[0][-1]) if runs[0] else 0: paths[0]}
    for place in range(1, min(map(len, runs)) + 1):
        numbers = [int(run[-place]) for run in runs]
        if len(set(numbers)) == len(numbers):
            return dict(sorted(zip(numbers, paths, strict=True)))
    raise BadInput(f"no number in the names of {paths[0]} to {paths[-1]} tells their frames apart: name one sequence")


def sequence_of(patterns: Mapping[str, Sequence[str]], numbers: str | None = None) -> list[FrameFiles]:
    """The frames of the patterns of all passes, by number; of "colour" as many as there are, within `numbers` "A-B".

    Raises BadInput where a pass lacks a frame, or no frame is left.
    """
    passes = {name: numbered(files_of(each)) for name, each in patterns.items()}
    first, last = frame_range(numbers)
    chosen = [number for number in passes[COLOUR] if first <= number <= last]
    if not chosen:
        have = list(passes[COLOUR])
        raise BadInput(f"there is no frame within --frames {numbers}: there are {have[0]} to {have[-1]}")
    for name, files in passes.items():
        missing = [number for number in chosen if number not in files]
        if missing:
            raise BadInput(
                f"'{' '.join(patterns[name])}' ({name}) lacks frame {missing[0]}: render it, or use --frames"
            )
    return [FrameFiles(number, {name: files[number] for name, files in passes.items()}) for number in chosen]


def frame_range(text: str | None) -> tuple[int, int]:
    """(first, last) of "A-B" or "A"; all for None. Raises BadInput for what is no such text."""
    if text is None:
        return 0, 2**62
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text)
    if not match:
        raise BadInput(f"'{text}' are no frames such as 1-24")
    return int(match[1]), int(match[2] or match[1])


def gaps(frames: Sequence[FrameFiles]) -> list[int]:
    """The numbers of frames that come right after missing ones: no history leads there."""
    return [after.number for before, after in pairwise(frames) if after.number != before.number + 1]


def shots(frames: Sequence[FrameFiles], resets: Sequence[int]) -> list[list[FrameFiles]]:
    """The frames cut at those numbers in `resets` where history begins anew.

    Raises BadInput for the number of no frame.
    """
    unknown = set(resets) - {frame.number for frame in frames}
    if unknown:
        raise BadInput(f"--reset-at {min(unknown)}: there is no such frame")
    cuts = {*resets, *gaps(frames)}
    parts: list[list[FrameFiles]] = []
    for frame in frames:
        if not parts or frame.number in cuts:
            parts.append([])
        parts[-1].append(frame)
    return parts
