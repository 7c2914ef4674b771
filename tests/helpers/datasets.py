"""What tests of data sets share: making the tiny one, telling two apart, and catching a job in the act."""

import hashlib
import sys
import time
from pathlib import Path
from typing import Any

from datasets.channels import CHANNELS
from models.registry import DENOISERS, channels_read
from render.job.generate import generate

# All but those for which Dr.Jit traces further paths in every frame.
MOST_CHANNELS = tuple(name for name in CHANNELS if CHANNELS[name].step not in ("hit_distance", "shadow_motion"))


def dataset_command(root: Path) -> list[str]:
    """`onespp dataset` for the tiny data set at `root`, with what all denoisers read."""
    everybody = ("--reads", *DENOISERS)
    return [sys.executable, "-m", "onespp", "dataset", "--profile", "tiny", "--data", str(root), *everybody]


def generate_tiny(root: Path, **arguments: Any) -> int:
    """What `dataset_command` does, in this process. `arguments` are further ones of render.job.generate.generate."""
    return generate(root, "tiny", seed=0, reads=channels_read(), **arguments)


def digest(root: Path) -> dict[str, str]:
    """Hashes of all visible files of a data set or clip except timings, by relative path."""
    return {
        str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(root.rglob("*"))
        if path.is_file() and path.name != "timing.json" and not path.name.startswith(".")
    }


def clip_in_progress(root: Path, seconds: float = 120) -> Path:
    """Wait until a process has begun to write a clip below `root`. Returns the clip's folder-to-be."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        for raw in root.glob("*/*/.*.tmp/direct.raw"):
            return raw.parent.with_name(raw.parent.name[1:].removesuffix(".tmp"))
        time.sleep(0.01)
    raise AssertionError(f"no clip below {root} was begun within {seconds} seconds")
