"""Builds the wheel of the C runtime."""

import shutil
import subprocess
import sys
from pathlib import Path

from errors import BadInput
from provenance import ROOT

BUILT = ["copies", "build", "*.egg-info", "_onespp.*", "__pycache__"]
BUILT += ["*.o", "*.a", "*.so", "*.raw", "example", "fuzz", "libfuzzer"]  # see .gitignore
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check", "wheel", "--quiet", "--no-deps", "--no-index")


def build_wheel(folder: Path) -> Path:
    """Compile copies in an empty folder, so that nothing is left in the source tree. Raises BadInput where that fails.

    The copy of the C files is FOLDER/runtime.
    """
    shutil.copytree(ROOT / "runtime", folder / "runtime", ignore=shutil.ignore_patterns(*BUILT))
    shutil.copyfile(ROOT / "LICENSE", folder / "LICENSE")
    try:
        subprocess.run([*PIP, "--no-build-isolation", "./runtime/python"], cwd=folder, check=True)
    except subprocess.CalledProcessError:
        needs = "it needs a C compiler, and setuptools 77 or newer"
        raise BadInput(f"the runtime was not compiled, see above: {needs}") from None
    [wheel] = folder.glob("*.whl")
    return wheel
