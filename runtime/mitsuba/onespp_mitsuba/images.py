"""Tensors and bitmaps of any variant as arrays of numpy: shapes and names are checked here."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]  # (H, W, C)

ROOT = "<root>"
CHANNELS = {"noisy": (1, 3, 4), "albedo": (3,), "normals": (3,), "flow": (2,), "emission": (3,)}
ONE_CHANNEL = (1,)  # of all others


def to_image(name: str, given: Any, size: tuple[int, int]) -> Image:
    """An image of `size` (H, W). Raises ValueError for another shape, and TypeError for what holds no floats."""
    array = given if isinstance(given, np.ndarray) else np.array(given)
    if array.dtype.kind != "f":
        raise TypeError(f"{name}: expected floats, got {type(given).__name__} of {array.dtype}")
    image = array[..., None] if array.ndim == 2 else array
    counts = CHANNELS.get(name, ONE_CHANNEL)
    if image.shape[:2] != size or image.ndim != 3 or image.shape[2] not in counts:
        expected = " or ".join(str((*size, count)) for count in counts)
        raise ValueError(f"{name}: expected shape {expected}, got {array.shape}")
    return image.astype(np.float32, copy=False)


def to_images(given: Mapping[str, Any], size: tuple[int, int]) -> dict[str, Image]:
    """Those that are not None."""
    return {name: to_image(name, image, size) for name, image in given.items() if image is not None}


def channels_of(bitmap: Any) -> dict[str, Image]:
    """The images of a bitmap by the name before the dot; those without one are ROOT."""
    names = [field.name for field in bitmap.struct_()]
    pixels = np.array(bitmap).reshape(bitmap.height(), bitmap.width(), len(names))
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(name.rpartition(".")[0] or ROOT, []).append(index)
    return {name: pixels[..., indices] for name, indices in groups.items()}


def named_channels(bitmap: Any, names: Mapping[str, str]) -> dict[str, Image]:
    """By argument, for those with a name. Raises ValueError for a name that the bitmap lacks."""
    channels = channels_of(bitmap)
    for argument, name in names.items():
        if name and name not in channels:
            raise ValueError(f"{argument}: the bitmap has no channel {name!r}; it has {', '.join(channels)}")
    return {argument: channels[name] for argument, name in names.items() if name}
