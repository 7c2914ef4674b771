"""Arrays of any library as arrays of numpy that C can read: their types and shapes are checked here, by name."""

from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

Shape = tuple[int, ...]
NUMBERS = "fiu"  # kinds of numpy's types: floats and integers


class SupportsDLPack(Protocol):
    """An array that other libraries can read by DLPack: of PyTorch, Dr.Jit, Mitsuba, JAX and so on."""

    def __dlpack__(self, *, stream: None = None) -> Any: ...


Array = ArrayLike | SupportsDLPack
"""What functions accept as an array, in the memory of the CPU."""


def to_numpy(name: str, array: Array) -> NDArray[Any]:
    """A view of the array where possible. Raises TypeError where it can't be read, as on a GPU."""
    try:
        if hasattr(array, "__dlpack__") and not isinstance(array, np.ndarray):
            return np.from_dlpack(cast(Any, array))
        return np.asarray(array)
    except Exception as error:  # each library raises its own
        raise TypeError(f"{name}: {type(array).__name__} is no array that numpy can read: {error}") from error


def check_shape(name: str, array: NDArray[Any], *allowed: Shape) -> None:
    """Raise ValueError where the shape is none of those allowed."""
    if array.shape not in allowed:
        raise ValueError(f"{name}: expected shape {' or '.join(map(str, allowed))}, got {array.shape}")


def readable(array: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """The array itself where C can read it by its strides, otherwise a copy."""
    by_items = all(stride % array.itemsize == 0 for stride in array.strides)
    if array.dtype == dtype and array.flags.aligned and by_items:
        return array
    with np.errstate(over="ignore", invalid="ignore"):  # too large a number becomes infinite, and counts as 0
        return np.ascontiguousarray(array, dtype)


def to_floats(name: str, array: Array) -> NDArray[np.float32]:
    """An image of float32. Raises TypeError for other numbers than floats: 8 bits are hardly linear radiance."""
    floats = to_numpy(name, array)
    if floats.dtype.kind != "f":
        raise TypeError(f"{name}: expected floats, got {floats.dtype}")
    return readable(floats, np.float32)


def to_colour(array: Array) -> NDArray[np.float32]:
    """The image that all others must be as large as."""
    image = to_floats("color", array)
    if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
        raise ValueError(f"color: expected shape (H, W, 3), got {image.shape}")
    return image


def to_image(name: str, array: Array, size: Shape, channels: int) -> NDArray[np.float32]:
    """An image (H, W, C) of `size` (H, W); of one channel it may be (H, W), too."""
    image = to_floats(name, array)
    check_shape(name, image, (*size, channels), *([size] if channels == 1 else []))
    return image[..., None] if image.ndim == 2 else image


def to_ids(name: str, array: Array, size: Shape) -> NDArray[np.int32]:
    """Whole numbers (H, W), or (H, W, 1), which may be stored as floats."""
    given = to_numpy(name, array)
    check_shape(name, given, size, (*size, 1))
    if given.dtype.kind not in NUMBERS:
        raise TypeError(f"{name}: expected integers, got {given.dtype}")
    ids = readable(given, np.int32)
    if ids is not given and not np.array_equal(ids, given):
        raise ValueError(f"{name}: expected whole numbers of at most 32 bits")
    return ids if ids.ndim == 2 else ids[..., 0]


def to_matrices(name: str, array: Array, shape: Shape) -> NDArray[np.float64]:
    """Finite float64 of a shape, in which -1 stands for any length."""
    given = to_numpy(name, array)
    if given.dtype.kind not in NUMBERS:
        raise TypeError(f"{name}: expected numbers, got {given.dtype}")
    if given.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, given.shape, strict=True)):
        raise ValueError(f"{name}: expected shape {str(shape).replace('-1', 'M')}, got {given.shape}")
    matrices = np.ascontiguousarray(given, np.float64)
    if not np.isfinite(matrices).all():
        raise ValueError(f"{name}: not all numbers are finite")
    return matrices


def to_poses(name: str, array: Array, shape: Shape) -> NDArray[np.float64]:
    """Rigid matrices (..., 4, 4): a scale, or translation in the last row, would silently lose history."""
    poses = to_matrices(name, array, shape)
    turns = poses[..., :3, :3]
    is_rigid = np.allclose(turns @ np.swapaxes(turns, -1, -2), np.eye(3), rtol=0, atol=1e-3)
    if not is_rigid or not (poses[..., 3, :] == (0, 0, 0, 1)).all():
        raise ValueError(f"{name}: expected rotation and translation alone, with the last row 0 0 0 1")
    return poses
