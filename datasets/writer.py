"""Writing one clip: frames in, one finished folder out or nothing."""

import shutil
import zlib
from collections.abc import Iterable
from contextlib import suppress
from filecmp import cmp
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from datasets.channels import CHANNELS, MIRRORED, REFERENCE_CHANNELS, SECOND_LAYER
from datasets.tonemap import clip_exposure, display, luminance, noise_of_mean
from files import write_json

FLOAT16_ROUNDING = 2.0**-11  # largest relative error of rounding to float16 in its normal range
FLOAT16_MAX = float(np.finfo(np.float16).max)


class RawChannel:
    """The frames of one channel on their way to disk, and what decides how they are stored."""

    def __init__(self, folder: Path, name: str):
        self.channel = CHANNELS[name]
        # Until the clip is complete, and the precision to store can be decided:
        self.working_dtype = np.dtype("<f4" if self.channel.dtype == "<f2" else self.channel.dtype)
        self.path = folder / f"{name}.raw"
        self.file = self.path.open("wb")
        self.frame_shape: tuple[int, ...] = ()
        self.frames = 0
        self.nonfinite = 0
        self.clamped = 0  # to the range of float16
        self.first_pixel: NDArray[Any] | None = None  # of an image
        self.constant = self.channel.is_image  # whether all pixels so far are equal
        self.float16_loses = False  # whether float16 would lose precision of what widens

    def add(self, array: NDArray[Any]) -> NDArray[Any]:
        """Append a frame, with the channel's axes but F, and return it. Non-finite numbers are counted and become 0."""
        array = np.ascontiguousarray(array, dtype=self.working_dtype)
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
            self.float16_loses |= not error <= FLOAT16_ROUNDING * np.abs(array).sum(dtype=np.float64)
        self.file.write(array.tobytes())
        self.frames += 1
        return array

    def read(self, frame: int) -> NDArray[Any]:
        count = int(np.prod(self.frame_shape))
        offset = frame * count * self.working_dtype.itemsize
        return np.fromfile(self.path, self.working_dtype, count, offset=offset).reshape(self.frame_shape)

    def finish(self, derived: str | None) -> dict[str, Any]:
        """Write the final file, if the channel is neither `derived` nor constant. Returns the entry of clip.json."""
        dtype = "<f4" if self.float16_loses else self.channel.dtype
        if derived:
            entry: dict[str, Any] = {"derived": derived}
        elif self.constant:
            assert self.first_pixel is not None
            entry = {"value": self.to_storage(self.first_pixel, dtype).tolist()}
        else:
            shape = (self.frames, *self.frame_shape)
            path = self.path.with_suffix(".npy")
            with path.open("w+b") as file:
                np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
                file.seek(0)
                checksum = zlib.crc32(file.read())
                for frame in range(self.frames):
                    data = self.to_storage(self.read(frame), dtype).tobytes()
                    checksum = zlib.crc32(data, checksum)
                    file.write(data)
            entry = {"file": path.name, "dtype": dtype, "shape": list(shape), "unit": self.channel.unit}
            entry["crc32"] = f"{checksum:08x}"
        self.path.unlink()
        return entry

    def to_storage(self, array: NDArray[Any], dtype: str) -> NDArray[Any]:
        """The array as `dtype`, clamped to the range of float16 where that has to stay finite."""
        if dtype != "<f2":
            return array.astype(dtype)
        self.clamped += int((np.abs(array) > FLOAT16_MAX).sum())
        return np.clip(array, -FLOAT16_MAX, FLOAT16_MAX).astype(dtype)


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
        self.frames = 0
        self.judged: list[int] = []  # frames with a reference
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
        """Append one frame: arrays by channel, with the axes of the channel table but F, and seconds by step.

        All frames have the same channels, but a frame that is not to be judged lacks the reference's.
        """
        for name in channels:
            if name not in self.channels:
                self.channels[name] = RawChannel(self.folder, name)
        added = {name: self.channels[name].add(array) for name, array in channels.items()}
        if REFERENCE_CHANNELS[0] in added:
            reference = sum(added[name].mean(axis=0) for name in REFERENCE_CHANNELS)
            self.luminances.append(luminance(np.asarray(reference)).astype(np.float32))
            self.judged.append(self.frames)
        self.frames += 1
        for step, spent in seconds.items():
            self.timing[step] = self.timing.get(step, 0.0) + spent

    def noise_floor(self, exposure: float) -> float:
        """The squared error of references as displayed: mean over frames of mean((display A - display B)^2) / 4."""
        floors = []
        for index, frame in enumerate(self.judged):
            buffers = sum(self.channels[name].read(index) for name in REFERENCE_CHANNELS)
            a, b = display((buffers + self.channels["emission"].read(frame)).astype(np.float64), exposure)
            floors.append(noise_of_mean(a, b))
        return float(np.mean(floors))

    def drop_layers(self) -> None:
        """Drop what mirrors and glass show where none is in view.

        What a mirror shows is always farther away, and glass that splits samples has a reflectance.
        """
        shown = self.channels.get(MIRRORED["depth"])
        if shown is not None and cmp(shown.path, self.channels["depth"].path, shallow=False):
            self.drop(MIRRORED.values())
        reflectance = self.channels.get("glass_reflectance")
        if reflectance is not None and reflectance.constant and not reflectance.first_pixel:
            self.drop(SECOND_LAYER)

    def drop(self, names: Iterable[str]) -> None:
        for name in self.channels.keys() & set(names):
            self.channels.pop(name).path.unlink()

    def finish(self, facts: dict[str, Any], derived: dict[str, str]) -> None:
        """Complete the clip. `facts` join clip.json; `derived` names channels that readers derive, and from what."""
        for raw in self.channels.values():
            raw.file.close()
        self.drop_layers()
        exposure = clip_exposure(np.stack(self.luminances))
        floor_mse = self.noise_floor(exposure)
        height, width = self.luminances[0].shape
        judged = {} if len(self.judged) == self.frames else {"judged": self.judged}
        content = {
            "frames": self.frames,
            "height": height,
            "width": width,
            **judged,
            **facts,
            "exposure": exposure,
            "channels": {name: raw.finish(derived.get(name)) for name, raw in self.channels.items()},
            "nonfinite": {name: raw.nonfinite for name, raw in self.channels.items()},
            "clamped": {name: raw.clamped for name, raw in self.channels.items()},
            "floor_mse": floor_mse,
            "complete": True,
        }
        write_json(self.folder / "timing.json", self.timing)
        write_json(self.folder / "clip.json", content)
        shutil.rmtree(self.destination, ignore_errors=True)  # whatever is there has no clip.json, so it is no clip
        self.folder.rename(self.destination)
