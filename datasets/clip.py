"""Reading clips and data sets straight from memory maps."""

import math
import resource
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tokenize import TokenError
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from datasets.channels import CHANNELS
from errors import BadInput
from files import read_json
from scenes.camera import View, motion_vectors, pixel_centres

SCHEMA = 1
SPLITS = ("train", "val", "test")
CLIP_FACTS = ("frames", "height", "width", "exposure", "channels", "floor_mse", "nonfinite", "clamped", "complete")
WHOLE = (slice(None), slice(None))

Window = tuple[slice, slice]  # rows, columns


def is_clip(path: Path) -> bool:
    """Whether a whole clip stands at `path`: clips appear by renaming, with clip.json inside."""
    return (path / "clip.json").exists()


class Clip:
    """One clip on disk. Nothing is read until it is asked for, and then only the window asked for.

    Raises BadInput, naming the file, where the clip is missing, incomplete or damaged.
    """

    def __init__(self, path: Path):
        self.path = path
        self.facts = read_json(path / "clip.json", CLIP_FACTS)
        if not self.facts["complete"]:
            raise BadInput(f"{path} is not a complete clip: delete it and rerun `onespp dataset`")
        self.frames: int = self.facts["frames"]
        self.height: int = self.facts["height"]
        self.width: int = self.facts["width"]
        self.channels: dict[str, dict[str, Any]] = self.facts["channels"]
        self._maps: dict[str, NDArray[Any]] = {}

    @property
    def scene(self) -> str:
        return self.path.parent.name

    @property
    def name(self) -> str:
        return self.path.name

    @property
    def fingerprint(self) -> str:
        """The checksum (crc32, 8 hex digits) of clip.json, which has those of all channels."""
        return f"{zlib.crc32((self.path / 'clip.json').read_bytes()):08x}"

    @property
    def exposure(self) -> float:
        return float(self.facts["exposure"])

    @property
    def realisations(self) -> int:
        entry = self.entry("direct")
        return entry["shape"][1] if "shape" in entry else 1

    def entry(self, channel: str) -> dict[str, Any]:
        """How a channel is stored. Raises BadInput where it was not rendered."""
        if channel not in self.channels:
            raise BadInput(f"{self.path} holds no '{channel}': it was not rendered; render the data set with it")
        return self.channels[channel]

    def map(self, channel: str) -> NDArray[Any]:
        """The memory-mapped array of a channel that has a file, checked against the shape that clip.json states."""
        if channel not in self._maps:
            entry, path = self.entry(channel), self.path / self.entry(channel)["file"]
            try:
                array = np.load(path, mmap_mode="r" if math.prod(entry["shape"]) else None)  # nothing cannot be mapped
            except FileNotFoundError:
                raise BadInput(f"{path} is missing: delete {self.path} and rerun `onespp dataset`") from None
            except (ValueError, EOFError, SyntaxError, TokenError) as error:  # np.load parses the header as Python
                raise BadInput(f"{path} is damaged ({error}): delete {self.path} and rerun `onespp dataset`") from None
            if list(array.shape) != entry["shape"] or array.dtype != np.dtype(entry["dtype"]):
                raise BadInput(f"{path} is not what clip.json says: delete {self.path} and rerun `onespp dataset`")
            self._maps[channel] = array
        return self._maps[channel]

    def read(self, channel: str, frame: int, window: Window = WHOLE, realisation: int = 0) -> NDArray[Any]:
        """One frame of a channel, cut to `window`: (h, w, C), or (2, h, w, C) for the reference halves.

        The same array whether the channel is stored in full, as one value or to be derived.
        """
        rows, columns = window
        entry = self.entry(channel)
        spec = CHANNELS[channel]
        if "value" in entry:
            area = np.empty((self.height, self.width), bool)[rows, columns].shape
            leading = (2,) if spec.axes[1] == 2 else ()
            value = np.array(entry["value"], "<f4" if spec.radiance else spec.dtype)
            return np.broadcast_to(value, (*leading, *area, spec.components))
        if "derived" in entry:
            return self.motion_to(frame, max(frame - 1, 0), window)
        array = self.map(channel)
        if "S" in spec.axes:
            return array[frame, realisation, rows, columns]
        return array[frame, ..., rows, columns, :]

    def view(self, frame: int) -> View:
        return View(*(np.array(self.map(name)[frame]) for name in ("K", "camera_to_world", "object_to_world")))

    def motion_to(self, frame: int, other: int, window: Window = WHOLE) -> NDArray[np.float32]:
        """Motion vectors (h, w, 2) from `frame` to any `other` frame of the clip, from depth, cameras and meshes."""
        pixels = pixel_centres(self.height, self.width)[window]
        depth = self.read("depth", frame, window)[..., 0].astype(np.float64)
        mesh_id = self.read("mesh_id", frame, window)[..., 0]
        return motion_vectors(pixels, depth, mesh_id, self.view(frame), self.view(other)).astype(np.float32)

    def reference(self, frame: int, signal: Literal["total", "indirect"] = "total") -> NDArray[np.float32]:
        """Both halves (2, H, W, 3) of the reference radiance: emission + direct + indirect, or indirect alone."""
        indirect = self.read("indirect_reference", frame).astype(np.float32)
        if signal == "indirect":
            return indirect
        direct, emission = (self.read(name, frame).astype(np.float32) for name in ("direct_reference", "emission"))
        return direct + indirect + emission


class Dataset:
    """A data set on disk: dataset.json and the clips it plans, by split.

    Raises BadInput where there is none, or one of another schema version.
    """

    def __init__(self, path: Path):
        self.path = path
        if not path.is_dir():
            raise BadInput(f"there is no data set at {path}: make one with `onespp dataset --data {path}`")
        self.facts = read_json(path / "dataset.json", ("schema",))
        if self.facts["schema"] != SCHEMA:
            raise BadInput(
                f"{path} has schema version {self.facts['schema']}, this onespp reads version {SCHEMA}: "
                "render it again with `onespp dataset` into a new folder"
            )

    def planned(self, splits: Sequence[str] = SPLITS) -> list[Path]:
        """Folders of all clips of `splits`, rendered or not, in a fixed order."""
        return [self.path / split / clip for split in splits for clip in self.facts["splits"][split]]

    def clips(self, split: str) -> list[Clip]:
        """The clips of a split. Raises BadInput where one has not been rendered yet, or none is planned."""
        paths = self.planned([split])
        missing = [path for path in paths if not is_clip(path)]
        if missing:
            raise BadInput(
                f"{self.path}: {len(missing)} of {len(paths)} clips of '{split}' are missing, first {missing[0]}; "
                "finish them with `onespp dataset`"
            )
        if not paths:
            raise BadInput(f"{self.path} has no clips to {split} with")
        allow_open_files(len(paths) * len(CHANNELS))
        return [Clip(path) for path in paths]


def allow_open_files(count: int) -> None:
    """Raise this process's limit by `count`, as far as it may: every memory map keeps a file open; 1024 are usual."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY:
        wanted = soft + count if hard == resource.RLIM_INFINITY else min(soft + count, hard)
        with suppress(ValueError, OSError):  # macOS has a limit beyond the one it tells
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
