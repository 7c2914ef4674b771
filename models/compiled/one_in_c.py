"""`one` as the C runtime (runtime/onespp.c) computes it, compiled at first use: faster than PyTorch with kernels.

It needs a C compiler and the runtime's sources, which a clone of onespp has.
"""

import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from threading import Lock
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from datasets.frame import Frame, Signal
from files import cache_folder
from models.denoiser import State, matching_state
from provenance import ROOT

RUNTIME = ROOT / "runtime"
CALLS = RUNTIME / "python" / "onespp_runtime" / "library.py"  # which calls the library beside it
C_FILES = tuple(RUNTIME / name for name in ("onespp.c", "onespp_avx2.c", "onespp_avx512.c", "python/threads.c"))
HEADERS = tuple(RUNTIME / name for name in ("onespp.h", "onespp_weights.h"))
FLAGS = ("-std=c99", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-DONESPP_DISPATCH", "-fPIC")

LAYERS = (  # in the order in which onespp.c reads them
    *("enter.0", "enter.1", "down_b.0", "down_b.1", "down_c.0", "down_c.1", "down_c.2"),
    *("up_b", "join_b", "up_a", "join_a", "leave", "detail.0", "detail.2"),
)
UPSAMPLING = ("up_b", "up_a", "leave")

ROOM_FOR_MESHES = 64  # room is made for multiples of so many
KEPT_SIZES = 2  # of frames, such as both layers of glass: their working memory stays

Weights = NDArray[np.float32]


def matrix(name: str, weight: Weights) -> Weights:
    """A layer's weights as a matrix (inputs, outputs).

    The inputs of 3 x 3 taps are in the order of channels, rows, columns; those of 2 x 2 pixels, and the outputs that
    become such, in the order of rows, columns, channels.
    """
    if name in UPSAMPLING:
        return weight.transpose(0, 2, 3, 1).reshape(len(weight), -1)
    if weight.shape[2:] == (2, 2):
        weight = weight.transpose(0, 2, 3, 1)
    return weight.reshape(len(weight), -1).T


def bias(name: str, tensors: Mapping[str, Weights]) -> Weights:
    """A layer's biases, one for each column of its matrix."""
    weight = tensors[f"{name}.weight"]
    values = tensors.get(f"{name}.bias", np.zeros(len(weight), np.float32))
    return np.tile(values, 4) if name in UPSAMPLING else values


def in_order(tensors: Mapping[str, Weights]) -> Weights:
    """The numbers of a network of `one`, by the names of its layers, as onespp.c reads them."""
    parts = [part.ravel() for name in LAYERS for part in (bias(name, tensors), matrix(name, tensors[f"{name}.weight"]))]
    return np.concatenate(parts)


def compile_library(compiler: str, folder: Path) -> None:
    """Make `folder`, complete or not at all: the library and the module that calls it. Raises CalledProcessError."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as temporary:
        made = Path(temporary) / "made"
        made.mkdir()
        shutil.copy(CALLS, made)
        objects = [str(made / f"{file.stem}.o") for file in C_FILES]
        files = zip(C_FILES, objects, strict=True)
        commands = [[compiler, *FLAGS, f"-I{RUNTIME}", "-c", str(file), "-o", to] for file, to in files]
        for each in [subprocess.Popen(command, stderr=subprocess.DEVNULL) for command in commands]:
            if each.wait():
                raise subprocess.CalledProcessError(each.returncode, compiler)
        library = str(made / "_onespp.so")
        subprocess.run([compiler, "-shared", *objects, "-o", library, "-lm", "-pthread"], check=True)
        try:
            made.rename(folder)
        except OSError:  # another process was faster
            if not folder.exists():
                raise


def find_compiler() -> str | None:
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def digest() -> str:
    """SHA-256 of the runtime's sources and how they are compiled, as hexadecimal digits."""
    contents = [file.read_bytes() for file in (*C_FILES, *HEADERS, CALLS)]
    command = " ".join((str(find_compiler()), *FLAGS))
    return hashlib.sha256(b"\0".join([*contents, command.encode()])).hexdigest()


def tell(text: str) -> None:
    tqdm.write(f"one: {text}", file=sys.stderr)


@cache
def runtime() -> ModuleType | None:
    """The module that calls the runtime; None where it can't be compiled, which is said on the console."""
    if not CALLS.exists() or sys.platform == "win32":
        return None
    compiler = find_compiler()
    if compiler is None:
        tell("no C compiler is found (cc, gcc or clang): it runs in PyTorch, which takes longer")
        return None
    folder = cache_folder() / f"one-{digest()[:16]}"
    try:
        if not folder.exists():
            tell(f"{compiler} compiles it for this machine, once, which takes seconds")
            compile_library(compiler, folder)
        spec = spec_from_file_location("onespp_in_c", folder / CALLS.name)
        assert spec and spec.loader
        module = module_from_spec(spec)
        spec.loader.exec_module(module)
    except (OSError, subprocess.CalledProcessError) as error:
        tell(f"it runs in PyTorch, which takes longer, because its C code can't be compiled or loaded: {error}")
        return None
    return module


def is_available() -> bool:
    """Whether this machine runs it; compiles it if need be, which takes seconds, once."""
    return runtime() is not None


def limited_isa() -> str:
    """The highest instruction set: oneDNN's environment variable, which limits PyTorch and OIDN, does so here, too."""
    return {"AVX2": "avx2", "SSE41": "baseline"}.get(os.environ.get("ONEDNN_MAX_CPU_ISA", "").upper(), "any")


@dataclass(frozen=True)
class StateInC(State):
    """A history of the runtime, and the denoised parts of the light of the frame that left it, if it had any."""

    handle: Any  # library.Handle
    history: Tensor  # of bytes
    parts: Tensor | None  # radiance (1, 3 P, H, W)

    def pictures(self) -> dict[str, Tensor]:
        _, height, width = self.moment.shape
        channels = self.handle.read_history(self.history.data_ptr(), height, width)
        images = torch.from_numpy(channels).movedim(-1, 0)[None]
        return {"history length": images[:, 6:7], "accumulated": images[:, 3:6]}


def pixels_of(images: Tensor) -> NDArray[Any]:
    """A view (H, W, C) of images (1, C, H, W)."""
    return images[0].movedim(0, -1).numpy()


def mesh_count(frame: Frame) -> int:
    return frame.now.object_to_world.shape[1]


def is_within_limits(frame: Frame, limits: ModuleType) -> bool:
    """Whether a frame is as small as those of the runtime, whose module has the limits."""
    fits = max(frame.size) <= limits.MAX_SIDE and mesh_count(frame) <= limits.MAX_MESHES
    samples = frame.samples.flatten()
    counts = (samples >= limits.MIN_SAMPLES).all() and (samples <= limits.MAX_SAMPLES).all()
    return fits and frame.part_count <= limits.MAX_PARTS and bool(counts)


class OneInC:
    """`one` with the weights of a network, for one frame at a time (B = 1) in float32 on the CPU."""

    def __init__(self, tensors: Mapping[str, Tensor]):
        """`tensors` are those of the network by name."""
        self.__setstate__(in_order({name: tensor.numpy() for name, tensor in tensors.items()}))

    def __setstate__(self, weights: Weights) -> None:
        self.weights = weights
        self.library = runtime()
        self.handles: dict[tuple[int, ...], Any] = {}  # by what they are for, the last one used last
        self.lock = Lock()  # one frame at a time: all use the same working memory

    def __getstate__(self) -> Weights:
        """Of copies and other processes, which have working memory and threads of their own."""
        return self.weights

    def handle(self, frame: Frame) -> Any:
        """A denoiser of the runtime for frames of this kind, on as many threads as PyTorch uses."""
        assert self.library
        height, width = frame.size
        meshes = -(-mesh_count(frame) // ROOM_FOR_MESHES) * ROOM_FOR_MESHES
        threads = min(torch.get_num_threads(), self.library.MAX_THREADS)
        key = (width, height, meshes, threads, frame.part_count)
        found = self.handles.pop(key, None)
        if found is None:
            found = self.library.Handle(*key[:4], limited_isa(), key[4], self.weights)
        self.handles[key] = found
        while len(self.handles) > KEPT_SIZES:
            del self.handles[next(iter(self.handles))]
        return found

    def takes(self, frame: Frame) -> bool:
        """Whether it can denoise the frame: within the limits of onespp.h, and not in training.

        In training alone, frames have gains, gradients and are crops of others.
        """
        if self.library is None or not is_within_limits(frame, self.library):
            return False
        is_trained_on = frame.colour_gain is not None or frame.whole is not None
        differentiates = torch.is_grad_enabled() and any(each.requires_grad for each in frame.channels.values())
        is_here = frame.shape[0] == 1 and frame.depth.device.type == "cpu"
        return is_here and not is_trained_on and not differentiates

    def denoise(self, frame: Frame, state: State | None, signal: Signal) -> tuple[Tensor, StateInC]:
        """Radiance (1, 3, H, W) and the state for the next frame: see Denoiser.forward."""
        assert self.library
        before = matching_state(state, StateInC, frame)
        height, width = frame.size
        given = self.library.FrameInputs(width=width, height=height, samples=frame.samples.item())
        lights = ("direct", "indirect", "emission") if signal == "total" else ("indirect",)
        for name, light in zip(("direct", "indirect", "emission"), lights, strict=False):
            given.set_image(name, pixels_of(frame.channel(light)))
        for name in ("albedo", "normal", "depth", "roughness", "motion"):
            given.set_image(name, pixels_of(frame.channel(name)))
        given.set_ids(frame.mesh_id[0, 0].to(torch.int32).numpy())
        given.K[:] = frame.now.K.flatten().tolist()
        given.camera_to_world[:] = frame.now.camera_to_world.flatten().tolist()
        given.set_poses(np.ascontiguousarray(frame.now.object_to_world[0].double().numpy()))
        parts = None if frame.parts is None else frame.parts.clone()  # they are denoised in place
        images = () if parts is None else [pixels_of(part[None]) for part in parts[0].split(3)]
        given.set_parts(images, frame.masks)
        past = before.history.data_ptr() if before else None  # with other parts it is not continued
        radiance = torch.empty(1, 3, height, width)
        with self.lock:
            handle = self.handle(frame)
            after = torch.empty(handle.history_size, dtype=torch.uint8)
            handle.denoise_from(past, after.data_ptr(), given, self.library.strided_image(pixels_of(radiance)))
        return radiance, StateInC(frame.moment, handle, after, parts)
