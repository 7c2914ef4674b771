"""The Python package of the C runtime, built once."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path
from shutil import copyfile, copytree, ignore_patterns, which

import pytest

from provenance import ROOT
from tests.helpers.c_runtime import FOLDER

CC = which("cc") or which("gcc") or which("clang")


def pip(*arguments: str, cwd: Path) -> None:
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    subprocess.run(command, cwd=cwd, check=True, env=os.environ | {"CC": CC}, capture_output=True)


@pytest.fixture(scope="session")
def wheel(tmp_path_factory) -> Path:
    """Built from copies, so that nothing is left in the source tree."""
    if CC is None:
        pytest.skip("there is no C compiler")
    folder = tmp_path_factory.mktemp("wheel")
    built = ignore_patterns("copies", "build", "*.egg-info", "_onespp.*")
    copytree(FOLDER, folder / "runtime", ignore=built)
    copyfile(ROOT / "LICENSE", folder / "LICENSE")
    pip("wheel", "--no-deps", "--no-index", "--no-build-isolation", "./runtime/python", cwd=folder)
    [file] = folder.glob("*.whl")
    return file


@pytest.fixture(scope="session")
def unpacked(wheel, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("unpacked")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder
