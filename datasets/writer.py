"""Writing one clip: frames in, one finished folder out or nothing."""

import shutil
import zlib
from contextlib import suppress
from filecmp import cmp
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from datasets.channels import CHANNELS, MIRRORED, REFERENCE_CHANNELS, Channel
from datasets.tonemap import clip_exposure, display, luminance, noise_of_mean
from files import write_json

HALF_PRECISION = 2.0**-11  # largest relative error of rounding to float16 in its normal range


def working_dtype(channel: Channel) -> str:
    """The precision in which frames are kept until the clip is whole and the precision to store can be decided."""
    return "<f4" if channel.dtype == "<f2" else channel.dtype


class RawChannel:
    """The frames of one channel on their way to disk, and what decides how they are stored."""

    def __init__(self, folder: Path, name: str):
        self.name = name
        self.channel = CHANNELS[name]
        self.path = folder / f"{name}.raw"
        self.file = self.path.open("wb")
        self.frame_shape: tuple[int, ...] = ()
        self.frames = 0
        self.nonfinite = 0
        self.first_pixel: NDArray[Any] | None = None  # of an image
        self.constant = self.channel.is_image  # whether all pixels so far are equal
        self.half_loses = False  # whether float16 would lose precision of what widens

    def add(self, array: NDArray[Any]) -> NDArray[Any]:
        """Append one frame, with the channel's axes but F. Non-finite numbers are counted and become 0.

        Returns the frame as it was appended.
        """
        array = np.ascontiguousarray(array, dtype=working_dtype(self.channel))
        if array.dtype.kind == "f":
            finite = np.isfinite(array)
            self.nonfinite += int(array.size - finite.sum())
            array = np.where(finite, array, 0)
        if self.frames == 0:
            self.frame_shape = array.shape
            self.first_pixel = array[(0,) * (array.ndim - 1)] if self.channel.is_image else None
        self.constant = self.constant and bool((array == self.first_pixel).all())
        if self.channel.widens:
            with np.errstate(over="ignore"):
                error = np.abs(array.astype("<f2").astype("<f8") - array).sum()
            self.half_loses |= not error <= HALF_PRECISION * np.abs(array).sum(dtype=np.float64)
        self.file.write(array.tobytes())
        self.frames += 1
        return array

    def read(self, frame: int) -> NDArray[Any]:
        """An appended frame, in working precision."""
        dtype = np.dtype(working_dtype(self.channel))
        count = int(np.prod(self.frame_shape))
        return np.fromfile(self.path, dtype, count, offset=frame * count * dtype.itemsize).reshape(self.frame_shape)

    def storage_dtype(self) -> str:
        """float32 for what widens, where float16 would round some frame worse than it rounds normal numbers."""
        return "<f4" if self.half_loses else self.channel.dtype

    def finish(self, derived: str | None) -> tuple[dict[str, Any], int]:
        """Write the final file where one is needed; `derived` says what the channel is derived from, if it is.

        Returns the entry of clip.json and how many numbers were clamped.
        """
        dtype = self.storage_dtype()
        if derived:
            entry: dict[str, Any] = {"derived": derived}
            clamped = 0
        elif self.constant:
            assert self.first_pixel is not None
            stored, clamped = to_storage(self.first_pixel, dtype)
            entry = {"value": stored.tolist()}
        else:
            entry, clamped = self._write_array(dtype)
        self.path.unlink()
        return entry, clamped

    def _write_array(self, dtype: str) -> tuple[dict[str, Any], int]:
        shape = [self.frames, *self.frame_shape]
        clamped = 0
        path = self.path.with_suffix(".npy")
        with path.open("wb") as file:
            output = ChecksummedFile(file)
            header = {"descr": dtype, "fortran_order": False, "shape": tuple(shape)}
            np.lib.format.write_array_header_1_0(output, header)
            for frame in range(self.frames):
                stored, lost = to_storage(self.read(frame), dtype)
                clamped += lost
                output.write(stored.tobytes())
        crc32 = f"{output.crc32:08x}"
        return {"file": path.name, "dtype": dtype, "shape": shape, "unit": self.channel.unit, "crc32": crc32}, clamped


class ChecksummedFile:
    """A binary file that keeps the checksum of what is written to it."""

    def __init__(self, file: BinaryIO):
        self.file = file
        self.crc32 = 0

    def write(self, data: bytes) -> int:
        """Append `data`. Returns how many bytes were written."""
        self.crc32 = zlib.crc32(data, self.crc32)
        return self.file.write(data)


def to_storage(array: NDArray[Any], dtype: str) -> tuple[NDArray[Any], int]:
    """The array as `dtype`, and how many numbers were clamped to the range of float16 to stay finite."""
    if dtype != "<f2":
        return array.astype(dtype), 0
    limit = float(np.finfo(np.float16).max)
    return np.clip(array, -limit, limit).astype(dtype), int((np.abs(array) > limit).sum())


class ClipWriter:
    """Collects the frames of a clip in a hidden folder beside `destination`, which takes its place at the end.

    Use it as a context manager: `add` every frame, then `finish`. Leaving without `finish` removes everything written.
    Frames go to disk at once; only the luminance of the reference stays in memory, for the exposure.
    """

    def __init__(self, destination: Path):
        self.destination = destination
        self.folder = destination.with_name(f".{destination.name}.tmp")
        self.channels: dict[str, RawChannel] = {}
        self.luminances: list[NDArray[np.float32]] = []
        self.timing: dict[str, float] = {}

    def __enter__(self) -> "ClipWriter":
        shutil.rmtree(self.folder, ignore_errors=True)  # left by a killed job
        self.folder.mkdir(parents=True)
        return self

    def __exit__(self, *_: object) -> None:
        for raw in self.channels.values():
            with suppress(OSError):  # on a full disk closing fails as well, and the first error is the one to report
                raw.file.close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def add(self, channels: dict[str, NDArray[Any]], seconds: dict[str, float]) -> None:
        """Append one frame: arrays by channel, with the axes of the channel table but F, and seconds by step."""
        if not self.channels:
            self.channels = {name: RawChannel(self.folder, name) for name in channels}
        added = {name: raw.add(channels[name]) for name, raw in self.channels.items()}
        reference = sum(added[name].mean(axis=0) for name in REFERENCE_CHANNELS)
        self.luminances.append(luminance(np.asarray(reference)).astype(np.float32))
        for step, spent in seconds.items():
            self.timing[step] = self.timing.get(step, 0.0) + spent

    def noise_floor(self, exposure: float) -> float:
        """The squared error of references as displayed: mean over frames of mean((display A - display B)^2) / 4."""
        floors = []
        for frame in range(len(self.luminances)):
            emission = self.channels["emission"].read(frame)
            halves = sum(self.channels[name].read(frame) for name in REFERENCE_CHANNELS) + emission
            a, b = display(halves.astype(np.float64), exposure)
            floors.append(noise_of_mean(a, b))
        return float(np.mean(floors))

    def leave_out_unseen_mirrors(self) -> None:
        """Drop the channels of what mirrors show where none is in view: what one shows is always farther away."""
        shown = self.channels.get(MIRRORED["depth"])
        if shown is None or not cmp(shown.path, self.channels["depth"].path, shallow=False):
            return
        for name in MIRRORED.values() & self.channels.keys():
            self.channels.pop(name).path.unlink()

    def finish(self, facts: dict[str, Any], derived: dict[str, str]) -> None:
        """Complete the clip. `facts` join clip.json; `derived` says which channels readers derive, and from what."""
        for raw in self.channels.values():
            raw.file.close()
        self.leave_out_unseen_mirrors()
        exposure = clip_exposure(np.stack(self.luminances))
        floor_mse = self.noise_floor(exposure)
        height, width = self.luminances[0].shape
        entries = {}
        clamped = {}
        for name, raw in self.channels.items():
            entries[name], clamped[name] = raw.finish(derived.get(name))
        content = {
            "frames": len(self.luminances),
            "height": height,
            "width": width,
            **facts,
            "exposure": exposure,
            "channels": entries,
            "nonfinite": {name: raw.nonfinite for name, raw in self.channels.items()},
            "clamped": clamped,
            "floor_mse": floor_mse,
            "complete": True,
        }
        write_json(self.folder / "timing.json", self.timing)
        write_json(self.folder / "clip.json", content)
        shutil.rmtree(self.destination, ignore_errors=True)  # whatever is there has no clip.json, so it is no clip
        self.folder.rename(self.destination)
