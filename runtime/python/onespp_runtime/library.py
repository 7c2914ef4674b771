"""The C library and its structures, as in onespp.h."""

import ctypes
import sys
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ABI = 3
ISAS = ("any", "baseline", "avx2", "avx512")
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

    def set_parts(self, arrays: Sequence[NDArray[np.float32]]) -> None:
        """Parts of the light, which are denoised in place."""
        self.kept += arrays
        images = map(strided_image, arrays)
        self.parts, self.part = len(arrays), (Part * len(arrays))(*(Part(image, image) for image in images))

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
    library.onespp_denoise.argtypes = [pointer, pointer, pointer]
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
    """An onespp: the denoiser with the memory it takes and its threads. Raises MemoryError without enough."""

    def __init__(self, width: int, height: int, max_meshes: int, threads: int, max_isa: str, max_parts: int):
        self.pool = ThreadPool(threads)
        self.threads = threads if self.pool.handle else 1
        tasks = 2 * self.threads if self.threads > 1 else 1  # twice as many even out their work
        run = ctypes.cast(LIBRARY.onespp_pool_run, ctypes.c_void_p) if self.pool.handle else None
        config = Config(ABI, width, height, max_meshes, tasks, run, self.pool.handle, ISAS.index(max_isa), max_parts)
        self.memory: NDArray[Any] = np.empty(LIBRARY.onespp_size(ctypes.byref(config)), np.uint8)
        self.pointer = ctypes.c_void_p()
        memory = self.memory.ctypes.data, self.memory.size
        check(LIBRARY.onespp_create(ctypes.byref(config), *memory, ctypes.byref(self.pointer)))
        self.isa = ISAS[LIBRARY.onespp_isa(self.pointer)]

    def denoise(self, frame: FrameInputs, radiance: StridedImage) -> None:
        check(LIBRARY.onespp_denoise(self.pointer, ctypes.byref(frame), ctypes.byref(radiance)))
