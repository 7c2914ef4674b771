"""The Python package of the C runtime, built once."""

import zipfile
from pathlib import Path
from shutil import which

import pytest

from runtime.wheel import build_wheel

CC = which("cc") or which("gcc") or which("clang")


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    if CC is None:
        pytest.skip("there is no C compiler")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CC", CC)
        return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def unpacked(wheel, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("unpacked")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder
