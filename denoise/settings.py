"""What the frames in an output folder were made with: kept beside them, so that no folder mixes two ways."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from errors import BadInput
from files import read_json, write_json

FILE = "denoise.json"


def claim(out: Path, settings: Mapping[str, Any]) -> None:
    """Make the folder and note the settings in it. Raises BadInput where others are noted there."""
    out.mkdir(parents=True, exist_ok=True)
    path = out / FILE
    if not path.exists():
        write_json(path, dict(settings))
        return
    noted = read_json(path)
    changed = [key for key in sorted(settings.keys() | noted.keys()) if settings.get(key) != noted.get(key)]
    if changed:
        raise BadInput(f"{out} holds frames denoised with other settings ({', '.join(changed)}): choose another --out")
