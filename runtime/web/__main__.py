"""A page that denoises a clip live: the C runtime as WebAssembly and the clip, in one file that needs nothing else.

`python -m runtime.web CLIP PAGE [FRAMES]` writes it; by default with as many frames as fit into about 30 MB.
"""

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from datasets.clip import Clip
from datasets.frame import read_frame
from datasets.tonemap import display
from errors import BadInput
from files import write_file
from models.registry import prototype
from runtime.raw import raw
from runtime.script import exits_in_words
from web_page import deflated, filled, packed

HERE = Path(__file__).parent
MODULE = HERE / "onespp.wasm"
MOST_PIXELS = 1_500_000  # of all frames, unless their number is given: each takes about 20 bytes
REMEDY = "install Clang for WebAssembly, on Debian `apt-get install clang lld wasi-libc libclang-rt-dev-wasm32`"


def module() -> bytes:
    """The runtime as WebAssembly, compiled if it is out of date. Raises BadInput where that fails."""
    name = str(MODULE.relative_to(HERE.parent))
    try:
        subprocess.run(["make", "-C", str(HERE.parent), name], check=True, capture_output=True, text=True)
    except FileNotFoundError:
        raise BadInput(f"the runtime cannot be compiled without make: {REMEDY}") from None
    except subprocess.CalledProcessError as error:
        reason = next(iter(error.stderr.splitlines()), "")
        raise BadInput(f"the runtime cannot be compiled to WebAssembly ({reason}): {REMEDY}") from None
    return MODULE.read_bytes()


def page_frame(clip: Clip, index: int) -> dict[str, str | None]:
    """A raw frame and, where the clip has one, its reference as displayed: RGBA of 8 bits."""
    reference = None
    if index in clip.judged:
        displayed = display(clip.reference(index).mean(axis=0), clip.exposure)
        opaque = np.full((clip.height, clip.width, 4), 255, np.uint8)
        opaque[..., :3] = 255 * displayed + 0.5
        reference = packed(opaque.tobytes())
    frame = read_frame(clip, index, prototype("one").reads, in_layers=False)
    return {"raw": packed(raw(frame, reset=index == 0)), "reference": reference}


def page(clip: Clip, frames: int) -> str:
    """The HTML of a clip's first frames."""
    content: dict[str, Any] = {
        "name": f"{clip.scene}/{clip.name}",
        "width": clip.width,
        "height": clip.height,
        "samples": clip.facts["noisy_spp"],
        "meshes": clip.visible_view(0).object_to_world.shape[0],
        "exposure": clip.exposure,
        "module": deflated(module()),
        "frames": [page_frame(clip, index) for index in range(frames)],
    }
    template = (HERE / "page.html").read_text().replace("/* WORKER */", (HERE / "worker.js").read_text())
    return filled(template, content)


def write_live_page(source: Path, path: Path, frames: int | None = None) -> None:
    """Raises BadInput where there is no clip with so many frames, or no compiler for WebAssembly."""
    clip = Clip(source)
    frames = frames or min(clip.frames, max(1, MOST_PIXELS // (clip.height * clip.width)))
    if frames > clip.frames:
        raise BadInput(f"{source} has {clip.frames} frames, not {frames}")
    write_file(path, page(clip, frames).encode())


def main(arguments: list[str]) -> None:
    if len(arguments) not in (2, 3) or not all(text.isdecimal() and int(text) for text in arguments[2:]):
        sys.exit(__doc__)
    with exits_in_words():
        write_live_page(Path(arguments[0]), Path(arguments[1]), *map(int, arguments[2:]))


if __name__ == "__main__":
    main(sys.argv[1:])
