"""Frames as the raw sequences that raw.h describes.

`python -m runtime.raw CLIP|WxH FRAMES FILE` writes a clip's frames, or synthetic ones of a size.
"""

import struct
import sys
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from datasets.clip import Clip
from datasets.frame import Frame, Moment, read_frame
from errors import BadInput
from eval.bench.denoisers import parse_size
from eval.bench.synthetic_frames import synthetic_frame
from files import replacing
from models.registry import prototype
from runtime.script import exits_in_words

PLANES = ("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "motion")


def raw(frame: Frame, reset: bool) -> bytes:
    """One frame (B = 1)."""
    height, width = frame.size
    poses = frame.now.object_to_world[0].numpy()
    header = struct.pack("<4i", width, height, reset, len(poses))
    numbers = [frame.samples.view(1), frame.now.K.flatten(), frame.now.camera_to_world.flatten()]
    cameras = np.concatenate([each.double().numpy() for each in numbers])
    images = (frame.channels[name][0].numpy().astype("<f4") for name in PLANES)
    mesh_id = frame.mesh_id[0].numpy().astype("<i4")
    return b"".join([header, *(array.tobytes() for array in (cameras, poses, *images, mesh_id))])


def write_raw(frames: Iterable[Frame], path: Path) -> None:
    """Write a sequence, which resets wherever a frame does not follow the one before. Atomic."""
    before: Moment | None = None
    with replacing(path) as temporary, temporary.open("wb") as file:
        for frame in frames:
            file.write(raw(frame, reset=before is None or not frame.follows(before)))
            before = frame.moment


def main(source: str, count: int, path: Path) -> None:
    """Raises BadInput where the source is neither a clip with so many frames nor a size."""
    if Path(source).is_dir():
        clip = Clip(Path(source))
        if count > clip.frames:
            raise BadInput(f"{source} has {clip.frames} frames, not {count}")
        write_raw((read_frame(clip, index, prototype("one").reads) for index in range(count)), path)
    else:
        height, width = parse_size(source)
        write_raw((synthetic_frame(index, height, width) for index in range(count)), path)


if __name__ == "__main__":
    if len(sys.argv) != 4 or not sys.argv[2].isdecimal():
        sys.exit(__doc__)
    with exits_in_words():
        main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]))
