"""Compiles the C runtime as a shared library that ctypes loads, so that one wheel serves every version of Python."""

import shutil
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

HERE = Path(__file__).resolve().parent
COPIES = HERE / "copies"  # of files above this folder: an sdist has only what lies below it
C_FILES = ["onespp.c", "onespp_avx2.c", "onespp_avx512.c"]
SOURCES = [HERE.parent / name for name in (*C_FILES, "onespp.h", "onespp_weights.h")]
LICENSE = HERE.parents[1] / "LICENSE"
EXPORTED = ["abi", "size", "create", "denoise", "isa", "message", "pool_create", "pool_run", "pool_destroy"]


def copy_sources() -> None:
    """Bring the copies up to date. An sdist has them already."""
    if SOURCES[0].exists():
        COPIES.mkdir(exist_ok=True)
        for file in (*SOURCES, LICENSE):
            shutil.copyfile(file, COPIES / file.name)


class BuildLibrary(build_ext):  # type: ignore[misc]
    """Builds a library that knows nothing of Python."""

    def build_extensions(self) -> None:
        is_msvc = self.compiler.compiler_type == "msvc"
        for extension in self.extensions:
            flags = ["-std=c99", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-pthread"]
            flags.append("-fno-wrapv")  # of Python's own flags -fwrapv keeps GCC from vectorising the filter
            extension.extra_compile_args = ["/std:c11", "/O2"] if is_msvc else flags
            extension.extra_link_args = [] if is_msvc else ["-pthread", "-lm"]
        super().build_extensions()

    def get_ext_filename(self, fullname: str) -> str:
        """Without the version of Python."""
        return str(Path(*fullname.split("."))) + (".dll" if sys.platform == "win32" else ".so")

    def get_export_symbols(self, ext: Extension) -> list[str]:
        """Without PyInit."""
        return ext.export_symbols


class AnyPythonWheel(bdist_wheel):  # type: ignore[misc]
    """A wheel for one platform and any Python 3."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", super().get_tag()[2]


copy_sources()
LIBRARY = Extension(
    "onespp_runtime._onespp",
    [*(f"copies/{name}" for name in C_FILES), "threads.c"],
    define_macros=[("ONESPP_DISPATCH", None)],
    include_dirs=["copies"],
    depends=["copies/onespp.h", "copies/onespp_weights.h"],
    export_symbols=[f"onespp_{name}" for name in EXPORTED],
)
setup(ext_modules=[LIBRARY], cmdclass={"build_ext": BuildLibrary, "bdist_wheel": AnyPythonWheel})
