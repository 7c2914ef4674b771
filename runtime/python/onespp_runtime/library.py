"""The C library and its structures, as in onespp.h."""

import ctypes
import sys
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ABI = 4
ISAS = ("any", "baseline", "avx2", "avx512")
HISTORY = 13  # channels: see onespp_read_history

# Limits of onespp.h. Each thread has two tasks.
MAX_SIDE = 16384
MAX_MESHES = 65536
MAX_THREADS = 512
MAX_PARTS = 16
MIN_SAMPLES, MAX_SAMPLES = 1e-3, 1e9

SUFFIX = ".dll" if sys.platform == "win32" else ".so"


class Config(ctypes.Structure):
    """onespp_config."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("abi", "max_width", "max_height", "max_meshes", "tasks")),
        ("parallel_for", ctypes.c_void_p),
        ("user", ctypes.c_void_p),
        ("max_isa", ctypes.c_int),
        ("max_parts", ctypes.c_int),
    )


class StridedImage(ctypes.Structure):
    """onespp_image, and onespp_output."""

    _fields_ = (("data", ctypes.c_void_p), *((name, ctypes.c_ssize_t) for name in ("channel", "row", "column")))


class Part(ctypes.Structure):
    """onespp_part."""

    _fields_ = (("noisy", StridedImage), ("radiance", StridedImage))


class StridedIds(ctypes.Structure):
    """onespp_ids."""

    _fields_ = (("data", ctypes.c_void_p), ("row", ctypes.c_ssize_t), ("column", ctypes.c_ssize_t))


IMAGES = ("direct", "indirect", "emission", "albedo", "normal", "depth", "roughness", "motion")


def strided_image(array: NDArray[np.float32]) -> StridedImage:
    """Of an array (H, W, C), which must outlive it."""
    row, column, channel = (stride // array.itemsize for stride in array.strides)
    return StridedImage(array.ctypes.data, channel, row, column)


class FrameInputs(ctypes.Structure):
    """onespp_frame, which keeps the arrays that it points to."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("width", "height", "reset")),
        ("samples", ctypes.c_float),
        *((name, StridedImage) for name in IMAGES),
        ("mesh_id", StridedIds),
        ("K", ctypes.c_double * 9),
        ("camera_to_world", ctypes.c_double * 16),
        ("meshes", ctypes.c_int),
        ("object_to_world", ctypes.c_void_p),
        ("parts", ctypes.c_int),
        ("part", ctypes.POINTER(Part)),
        ("masks", ctypes.c_int),
    )

    def __init__(self, **numbers: float):
        super().__init__(**numbers)
        self.kept: list[NDArray[Any]] = []

    def set_image(self, name: str, array: NDArray[np.float32]) -> None:
        self.kept.append(array)
        setattr(self, name, strided_image(array))

    def set_ids(self, array: NDArray[np.int32]) -> None:
        self.kept.append(array)
        self.mesh_id = StridedIds(array.ctypes.data, *(stride // array.itemsize for stride in array.strides))

    def set_parts(self, arrays: Sequence[NDArray[np.float32]], masks: int) -> None:
        """Parts of the light, which are denoised in place; the last ones are masks."""
        self.kept += arrays
        images = map(strided_image, arrays)
        self.parts, self.part = len(arrays), (Part * len(arrays))(*(Part(image, image) for image in images))
        self.masks = masks

    def set_poses(self, poses: NDArray[np.float64]) -> None:
        self.kept.append(poses)
        self.meshes, self.object_to_world = len(poses), poses.ctypes.data


def load() -> ctypes.CDLL:
    """The library, whose calls release Python's lock."""
    library = ctypes.CDLL(str(Path(__file__).with_name(f"_onespp{SUFFIX}")))
    pointer = ctypes.c_void_p
    library.onespp_message.restype = ctypes.c_char_p
    library.onespp_size.argtypes, library.onespp_size.restype = [pointer], ctypes.c_size_t
    library.onespp_create.argtypes = [pointer, pointer, ctypes.c_size_t, pointer]
    library.onespp_create_with.argtypes = [pointer, pointer, ctypes.c_size_t, pointer, ctypes.c_size_t, pointer]
    library.onespp_denoise.argtypes = [pointer, pointer, pointer]
    library.onespp_history_size.argtypes, library.onespp_history_size.restype = [pointer], ctypes.c_size_t
    library.onespp_denoise_from.argtypes = [pointer, pointer, pointer, pointer, pointer]
    library.onespp_read_history.argtypes, library.onespp_read_history.restype = [pointer, pointer, pointer], None
    library.onespp_isa.argtypes = [pointer]
    library.onespp_pool_create.restype = pointer
    library.onespp_pool_destroy.argtypes, library.onespp_pool_destroy.restype = [pointer], None
    return library


LIBRARY = load()


def check(error: int) -> None:
    """Raise ValueError for an error of the library."""
    if error:
        raise ValueError(LIBRARY.onespp_message(error).decode())


class ThreadPool:
    """Threads of the library. Its handle is None where there are none."""

    def __init__(self, threads: int):
        self.handle: int | None = LIBRARY.onespp_pool_create(threads) if threads > 1 else None
        # At exit they end with the process, even amid a frame.
        weakref.finalize(self, LIBRARY.onespp_pool_destroy, self.handle).atexit = False


class Handle:
    """An onespp: the denoiser with the memory it takes and its threads; by default with the shipped weights.

    Raises MemoryError without enough memory, and ValueError for another number of weights.
    """

    def __init__(
        self,
        width: int,
        height: int,
        max_meshes: int,
        threads: int,
        max_isa: str,
        max_parts: int,
        weights: NDArray[np.float32] | None = None,
    ):
        self.pool = ThreadPool(threads)
        self.threads = threads if self.pool.handle else 1
        tasks = 2 * self.threads if self.threads > 1 else 1  # twice as many even out their work
        run = ctypes.cast(LIBRARY.onespp_pool_run, ctypes.c_void_p) if self.pool.handle else None
        config = Config(ABI, width, height, max_meshes, tasks, run, self.pool.handle, ISAS.index(max_isa), max_parts)
        self.memory: NDArray[Any] = np.empty(LIBRARY.onespp_size(ctypes.byref(config)), np.uint8)
        self.history_size: int = LIBRARY.onespp_history_size(ctypes.byref(config))
        self.pointer = ctypes.c_void_p()
        memory = ctypes.byref(config), self.memory.ctypes.data, self.memory.size
        if weights is None:
            check(LIBRARY.onespp_create(*memory, ctypes.byref(self.pointer)))
        else:
            numbers = np.ascontiguousarray(weights, np.float32)
            check(LIBRARY.onespp_create_with(*memory, numbers.ctypes.data, numbers.size, ctypes.byref(self.pointer)))
        self.isa = ISAS[LIBRARY.onespp_isa(self.pointer)]

    def denoise(self, frame: FrameInputs, radiance: StridedImage) -> None:
        check(LIBRARY.onespp_denoise(self.pointer, ctypes.byref(frame), ctypes.byref(radiance)))

    def denoise_from(self, past: int | None, after: int, frame: FrameInputs, radiance: StridedImage) -> None:
        """From the history at address `past`, if any; writes that of the frame to `after`, `history_size` bytes."""
        check(LIBRARY.onespp_denoise_from(self.pointer, past, after, ctypes.byref(frame), ctypes.byref(radiance)))

    def read_history(self, history: int, height: int, width: int) -> NDArray[np.float32]:
        """The channels (H, W, HISTORY) of the history at an address, which a frame of that size left."""
        channels = np.empty((height, width, HISTORY), np.float32)
        LIBRARY.onespp_read_history(self.pointer, history, ctypes.byref(strided_image(channels)))
        return channels
