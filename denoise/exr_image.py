"""An OpenEXR file of any program in memory: its planes by name, its header, and writing it with changes."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray

from datasets.exr import silenced, write_file
from datasets.writer import FLOAT16_MAX
from errors import BadInput

NOTE_ATTRIBUTE = "denoised"  # of the header of an output

Window = tuple[int, int, int, int]  # left, top, right, bottom in pixels, the last two included


def plane_name(part: str, channel: str, several: bool) -> str:
    """The channel's name, after that of its part unless it is the file's only part or the name begins with it."""
    begins = channel.casefold().startswith(f"{part}.".casefold())
    return f"{part}.{channel}" if several and part and not begins else channel


def window_of(header: Mapping[str, Any]) -> Window:
    low, high = header["dataWindow"]
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def size_of(window: Window) -> tuple[int, int]:
    """(H, W)."""
    left, top, right, bottom = window
    return bottom - top + 1, right - left + 1


class ExrImage:
    """The planes (H, W) of all parts of a file. Raises BadInput where the file is missing, damaged or not an image."""

    def __init__(self, path: Path, header_only: bool = False):
        self.path = path
        if not path.is_file():
            raise BadInput(f"{path} is missing")
        try:
            with silenced():
                headers = OpenEXR.File(str(path), header_only=True)
                self.file = headers if header_only else OpenEXR.File(str(path), separate_channels=True)
        except (RuntimeError, ValueError, TypeError) as error:
            raise BadInput(f"{path} is damaged or not an OpenEXR image ({error}): render it again") from None
        if len(self.file.parts) < len(headers.parts) or not headers.parts:  # OpenEXR leaves out what it cannot read
            raise BadInput(f"{path} is damaged: render it again")
        several = len(self.file.parts) > 1
        by_size = sorted(self.file.parts, key=lambda part: math.prod(size_of(window_of(part.header))))
        # The largest part counts: others may be cropped.
        self.header: dict[str, Any] = {key: value for part in by_size for key, value in part.header.items()}
        self.window = window_of(self.header)
        self.height, self.width = size_of(self.window)
        self.channels: dict[str, Any] = {}
        self.windows: dict[str, Window] = {}  # by channel
        for part in self.file.parts:
            channels = part.channels or {channel.name: channel for channel in part.header["channels"]}
            planes = {plane_name(part.name(), name, several): channel for name, channel in channels.items()}
            self.channels |= planes
            self.windows |= dict.fromkeys(planes, window_of(part.header))

    def stacked(self, channels: Sequence[str]) -> NDArray[np.float32]:
        """The named channels as one array (H, W, C). Raises BadInput where one is missing, deep or otherwise placed."""
        planes = []
        for name in channels:
            if name not in self.channels:
                raise BadInput(f"{self.path} has no channel '{name}', which the first frame has")
            plane = self.channels[name].pixels
            if plane.dtype == object:
                raise BadInput(f"{self.path}: the channel '{name}' is deep: flatten the image")
            if plane.shape != (self.height, self.width) or self.windows[name] != self.window:
                raise BadInput(f"{self.path}: the channel '{name}' is subsampled or has another size or data window")
            planes.append(plane.astype(np.float32))
        return np.stack(planes, axis=-1)

    def replace(self, channels: Sequence[str], image: NDArray[np.float32], dtype: type | None) -> None:
        """Put `image` (H, W, C) in place of the named channels, in their own precision or in `dtype`."""
        for index, name in enumerate(channels):
            target = np.dtype(dtype or self.channels[name].pixels.dtype)
            limit = FLOAT16_MAX if target == np.float16 else np.inf
            self.channels[name].pixels = np.ascontiguousarray(image[..., index].clip(-limit, limit), target)

    def add(self, layer: str, image: NDArray[np.float32], beside: str) -> None:
        """Put `image` (H, W, 3), not negative, as R, G and B of a layer into the part that has the channel `beside`.

        It is in half precision. A layer of that name, in any part, is replaced.
        """
        home = next(part for part in self.file.parts if self.channels[beside] in part.channels.values())
        for index, component in enumerate("RGB"):
            name = f"{layer}.{component}"
            plane = np.ascontiguousarray(image[..., index].clip(0, FLOAT16_MAX), np.float16)
            if name in self.channels:
                self.channels[name].pixels = plane
            else:
                self.channels[name] = home.channels[name] = OpenEXR.Channel(name, plane)
                self.windows[name] = self.windows[beside]

    def write(self, path: Path, note: str) -> None:
        """Write everything atomically, with `note` in the header. Raises BadInput where that fails."""
        self.file.parts[0].header[NOTE_ATTRIBUTE] = note
        write_file(path, self.file)
