"""Mitsuba as we set it up."""

import os
import subprocess
import sys

import numpy as np
import OpenEXR
import pytest

READ_ON_ONE_CORE = """
import os, sys
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from render.backend import mi
print(mi.Bitmap(sys.argv[1]).size())
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be bound to a core here")
def test_one_core_is_enough_to_read_exr(tmp_path):
    path = tmp_path / "sky.exr"
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ones((64, 128, 3), np.float32)}) as file:
        file.write(str(path))
    command = [sys.executable, "-c", READ_ON_ONE_CORE, str(path)]
    assert subprocess.run(command, capture_output=True, text=True, timeout=60).stdout == "[128, 64]\n"
