"""Builds the extension for Blender on this platform, with the runtime for Python as a wheel in it.

`python -m runtime.blender OUT.zip` compiles for any processor of the platform, or as CFLAGS says.
"""

import platform
import sys
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory

from errors import BadInput
from files import replacing
from runtime.script import exits_in_words
from runtime.wheel import build_wheel

HERE = Path(__file__).resolve().parent
SYSTEMS = {"Linux": "linux", "Darwin": "macos", "Windows": "windows"}
MACHINES = {"x86_64": "x64", "AMD64": "x64", "aarch64": "arm64", "arm64": "arm64"}


def blender_platform() -> str:
    """This platform as Blender names it. Raises BadInput where there is no Blender for it."""
    system, machine = platform.system(), platform.machine()
    if system not in SYSTEMS or machine not in MACHINES:
        raise BadInput(f"there is no Blender for {system} on {machine}")
    return f"{SYSTEMS[system]}-{MACHINES[machine]}"


def build(out: Path) -> None:
    """Write the extension; atomic. Raises BadInput where the folder is missing, or see `build_wheel`."""
    if not out.parent.is_dir():
        raise BadInput(f"{out.parent} is no folder: make it first")
    with TemporaryDirectory() as folder, replacing(out) as temporary:
        wheel = build_wheel(Path(folder))
        added = f'platforms = ["{blender_platform()}"]\nwheels = ["./wheels/{wheel.name}"]\n'
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.write(HERE.parents[1] / "LICENSE", "LICENSE")
            archive.write(wheel, f"wheels/{wheel.name}")
            for source in sorted((HERE / "extension").iterdir()):
                if source.suffix == ".py":
                    archive.write(source, source.name)
                elif source.suffix == ".toml":
                    archive.writestr(source.name, added + source.read_text())


if __name__ == "__main__":
    if len(sys.argv) != 2 or not sys.argv[1].endswith(".zip"):
        sys.exit(__doc__)
    with exits_in_words():
        build(Path(sys.argv[1]))
