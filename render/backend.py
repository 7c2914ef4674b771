"""Mitsuba and Dr.Jit with the variant chosen: import `mi` and `dr` from here and nowhere else.

The CUDA variant is used if there is a GPU. Otherwise Dr.Jit compiles through LLVM and would load the first libLLVM that
it finds; versions before 17 abort the process on AVX-512 machines, so one is chosen before Mitsuba loads.
"""

import ctypes
import os
import re
import subprocess
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

from errors import BadInput

MIN_LLVM = 17
TESTED_LLVM = 19
SLOW_BRANCHES = (b"znver3",)  # processors, as LLVM names them, on which it avoids gathers although they are faster
MIN_THREADS = 2  # with one, Mitsuba waits forever for the first EXR that it reads or writes


def installed_llvms() -> list[tuple[int, str]]:
    """(major version, path) of every libLLVM in the loader's cache and the usual folders."""
    listing = ""
    with suppress(OSError):  # no ldconfig (musl, macOS): the folders below remain
        listing = subprocess.run(["/sbin/ldconfig", "-p"], capture_output=True, text=True).stdout
    paths = [line.rsplit("=> ", 1)[-1] for line in listing.splitlines() if "libLLVM" in line]
    for usual in ("usr/lib/llvm-*/lib", "usr/lib64", "opt/homebrew/opt/llvm*/lib"):
        paths += [str(path) for path in Path("/").glob(f"{usual}/libLLVM*")]
    found = []
    for path in paths:
        # The version is part of the resolved name (libLLVM-18.so.1, libLLVM.so.19.1) or of its folder (llvm-19).
        resolved = Path(path).resolve()
        name = re.fullmatch(r"libLLVM(?:-(\d+)[\d.]*)?\.(?:so|dylib)(?:\.(\d+)[\d.]*)?", resolved.name)
        versioned = re.search(r"llvm[-@/]?(\d+)", str(resolved.parent))
        if name and (version := name[1] or name[2] or (versioned[1] if versioned else "")):
            found.append((int(version), path))
    return found


def choose_llvm() -> None:
    """Set DRJIT_LIBLLVM_PATH, unless set, to the usable libLLVM nearest to the tested one. Raises BadInput without."""
    if "DRJIT_LIBLLVM_PATH" in os.environ:
        return
    usable = [(abs(version - TESTED_LLVM), path) for version, path in installed_llvms() if version >= MIN_LLVM]
    if not usable:
        raise BadInput(
            f"rendering on the CPU needs libLLVM {MIN_LLVM} or newer and none was found: install it "
            f"(Debian, Ubuntu: apt install libllvm{TESTED_LLVM}; macOS: brew install llvm) or set DRJIT_LIBLLVM_PATH"
        )
    os.environ["DRJIT_LIBLLVM_PATH"] = min(usable)[1]


def use_gathers(processors: Collection[bytes] = SLOW_BRANCHES) -> bool:
    """Have kernels use gather instructions on `processors` for which LLVM replaces them by slower branches per lane.

    Results stay the same to the bit (docs/experiments.md, Gathers). Dr.Jit offers this in C++ alone. Returns whether
    this is one of the processors.
    """
    core = ctypes.CDLL(str(Path(dr.__file__).parent / "libdrjit-core.so"))
    processor, features = core._Z19jit_llvm_target_cpuv, core._Z24jit_llvm_target_featuresv
    processor.restype = features.restype = ctypes.c_char_p
    if processor() not in processors:
        return False
    width = core._Z21jit_llvm_vector_widthv()
    core._Z19jit_llvm_set_targetPKcS0_j(processor(), features() + b",+fast-gather", width)
    return True


def has_cuda() -> bool:
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return False
    count = ctypes.c_int()
    return cuda.cuInit(0) == 0 and cuda.cuDeviceGetCount(ctypes.byref(count)) == 0 and count.value > 0


VARIANT = "cuda_ad_rgb" if has_cuda() else "llvm_ad_rgb"
if VARIANT == "llvm_ad_rgb":
    choose_llvm()

import drjit as dr  # noqa: E402 - must come after the choice
import mitsuba as mi  # noqa: E402

mi.set_variant(VARIANT)
mi.set_log_level(mi.LogLevel.Error)
if VARIANT == "llvm_ad_rgb":
    with suppress(OSError, AttributeError):  # no such library or function elsewhere than on Linux
        use_gathers()
dr.set_thread_count(max(MIN_THREADS, dr.thread_count()))

__all__ = ["MIN_THREADS", "VARIANT", "dr", "mi"]
