"""What tests of data sets share."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def tiny_copy(tiny: Path, tmp_path: Path) -> Path:
    """A copy of the tiny data set, to damage."""
    return Path(shutil.copytree(tiny, tmp_path / "copy"))
