"""The C runtime, built by the C compiler and called through ctypes with Frames."""

import ctypes
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from datasets.frame import Frame
from models.compiled.one_in_c import FLAGS, find_compiler
from models.networks.one import One
from models.registry import create, require_shipped
from models.weights import load_weights
from provenance import ROOT
from runtime.raw import PLANES

FOLDER = ROOT / "runtime"
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror")
OPTIMISED = FLAGS  # those that the library compiles it with
SOURCES = tuple(FOLDER / name for name in ("onespp.c", "onespp_avx2.c", "onespp_avx512.c"))
CC = find_compiler() or ""
ABI = 4
ISAS = {"any": 0, "baseline": 1, "avx2": 2, "avx512": 3}

Task = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int)
ParallelFor = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, Task, ctypes.c_void_p)


class Config(ctypes.Structure):
    """onespp_config."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("abi", "max_width", "max_height", "max_meshes", "tasks")),
        ("parallel_for", ParallelFor),
        ("user", ctypes.c_void_p),
        ("max_isa", ctypes.c_int),
        ("max_parts", ctypes.c_int),
    )


class Image(ctypes.Structure):
    """onespp_image, and onespp_output."""

    _fields_ = (("data", ctypes.c_void_p), *((name, ctypes.c_ssize_t) for name in ("channel", "row", "column")))


class Part(ctypes.Structure):
    """onespp_part."""

    _fields_ = (("noisy", Image), ("radiance", Image))


class Ids(ctypes.Structure):
    """onespp_ids."""

    _fields_ = (("data", ctypes.c_void_p), ("row", ctypes.c_ssize_t), ("column", ctypes.c_ssize_t))


class CFrame(ctypes.Structure):
    """onespp_frame."""

    _fields_ = (
        *((name, ctypes.c_int) for name in ("width", "height", "reset")),
        ("samples", ctypes.c_float),
        *((name, Image) for name in PLANES),
        ("mesh_id", Ids),
        ("K", ctypes.c_double * 9),
        ("camera_to_world", ctypes.c_double * 16),
        ("meshes", ctypes.c_int),
        ("object_to_world", ctypes.c_void_p),
        ("parts", ctypes.c_int),
        ("part", ctypes.POINTER(Part)),
        ("masks", ctypes.c_int),
    )


class Library(ctypes.CDLL):
    """The runtime, whose denoisers use at most the instruction set max_isa."""

    max_isa = ISAS["any"]


def build(target: Path, files: Sequence[Path], flags: Sequence[str] = OPTIMISED) -> Library:
    """The runtime as a shared library, of sources or object files."""
    subprocess.run([CC, *STRICT, *flags, "-fPIC", "-shared", *files, "-o", target, "-lm"], check=True)
    library = Library(str(target))
    library.onespp_size.restype = ctypes.c_size_t
    library.onespp_history_size.restype = ctypes.c_size_t
    library.onespp_message.restype = ctypes.c_char_p
    return library


def rounded_one() -> One:
    """`one` in PyTorch with the shipped weights in half precision, as the runtime has them."""
    denoiser = create("one")
    assert isinstance(denoiser, One)
    load_weights(denoiser, "one", require_shipped("one"))
    denoiser.prepare()
    for parameter in denoiser.parameters():
        parameter.data = parameter.half().float()
    return denoiser


def address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


class CRuntime:
    """A denoiser of the library, with the memory it takes."""

    def __init__(
        self,
        library: Library,
        width: int,
        height: int,
        meshes: int = 64,
        tasks: int = 1,
        parallel_for: Callable[..., None] | None = None,
        parts: int = 0,
    ):
        self.library = library
        callback = ParallelFor(parallel_for) if parallel_for else ParallelFor()
        self.config = Config(ABI, width, height, meshes, tasks, callback, None, library.max_isa, parts)
        self.size = library.onespp_size(ctypes.byref(self.config))
        self.memory = np.full(self.size, 0xFF, np.uint8)  # NaN, wherever something is read before it was written
        self.denoiser = ctypes.c_void_p()
        arguments = ctypes.byref(self.config), address(self.memory), ctypes.c_size_t(self.size)
        assert library.onespp_create(*arguments, ctypes.byref(self.denoiser)) == 0

    @property
    def isa(self) -> int:
        return self.library.onespp_isa(self.denoiser)

    def call(self, frame: CFrame, output: Image, histories: Sequence[ctypes.c_void_p | None] = ()) -> int:
        images = ctypes.byref(frame), ctypes.byref(output)
        if histories:
            return self.library.onespp_denoise_from(self.denoiser, *histories, *images)
        return self.library.onespp_denoise(self.denoiser, *images)

    def __call__(
        self,
        frame: Frame,
        reset: bool,
        interleaved: bool = False,
        without: Sequence[str] = (),
        histories: Sequence[ctypes.c_void_p | None] = (),
    ) -> Tensor:
        """Radiance (1, 3, H, W); by default with the denoiser's own history."""
        height, width = frame.size
        arrays: dict[str, Any] = {}
        given = CFrame(width=width, height=height, reset=reset, samples=frame.samples.item())
        for name in PLANES:
            if name in without:
                continue
            array = frame.channels[name][0].numpy()
            arrays[name] = np.ascontiguousarray(np.moveaxis(array, 0, -1) if interleaved else array, np.float32)
            setattr(given, name, strided(arrays[name], interleaved))
        if "mesh_id" not in without:
            arrays["mesh_id"] = np.ascontiguousarray(frame.mesh_id[0, 0].numpy().astype(np.int32))
            given.mesh_id = Ids(address(arrays["mesh_id"]), width, 1)
        poses = np.ascontiguousarray(frame.now.object_to_world[0].numpy())
        given.K[:] = frame.now.K[0].flatten().tolist()
        given.camera_to_world[:] = frame.now.camera_to_world[0].flatten().tolist()
        given.meshes, given.object_to_world = len(poses), address(poses)
        given.masks = frame.masks
        given.parts = frame.part_count
        parts = np.empty((0, height, width), np.float32)
        if frame.parts is not None:  # which are denoised in place
            parts = frame.parts[0].numpy().copy()
            images = [strided(part, False) for part in np.split(parts, given.parts)]
            given.part = (Part * given.parts)(*(Part(image, image) for image in images))
        output = np.full((height, width, 3) if interleaved else (3, height, width), np.nan, np.float32)
        assert self.call(given, strided(output, interleaved), histories) == 0
        self.parts = torch.from_numpy(parts)[None]
        return torch.from_numpy(np.moveaxis(output, -1, 0).copy() if interleaved else output)[None]


def strided(array: np.ndarray, interleaved: bool) -> Image:
    """Of an array (H, W, C) or (C, H, W)."""
    strides = [stride // array.itemsize for stride in array.strides]
    row, column, channel = strides if interleaved else (*strides[1:], strides[0])
    return Image(address(array), channel, row, column)
