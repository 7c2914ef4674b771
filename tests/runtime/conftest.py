"""The Python package of the C runtime, built once."""

import zipfile
from pathlib import Path

import pytest

from runtime.wheel import build_wheel
from tests.helpers.c_runtime import CC, SOURCES, STRICT, Library, build
from tests.helpers.shared import made_once


@pytest.fixture(scope="session")
def wheel(shared) -> Path:
    if not CC:
        pytest.skip("there is no C compiler")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CC", CC)
        patch.setenv("CFLAGS", " ".join(STRICT))
        [wheel] = made_once(shared / "wheel", build_wheel).glob("*.whl")
    return wheel


@pytest.fixture(scope="session")
def objects(wheel) -> dict[str, Path]:
    """The object files that the wheel is made of, by the names of their sources."""
    found = {path.stem: path for path in wheel.parent.rglob("*.o")}
    return {source.name: found[source.stem] for source in SOURCES}


@pytest.fixture(scope="session")
def library(objects, tmp_path_factory) -> Library:
    return build(tmp_path_factory.mktemp("runtime") / "libonespp.so", [*objects.values()])


@pytest.fixture(scope="session")
def unpacked(wheel, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("unpacked")
    zipfile.ZipFile(wheel).extractall(folder)
    return folder
