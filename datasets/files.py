"""Small files written so that a reader never sees half of one."""

import json
import os
from pathlib import Path
from typing import Any

from errors import BadInput


def write_file(path: Path, content: bytes) -> None:
    """Write atomically: whatever fails, what stood at `path` before still does. Raises OSError, on a full disk too."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Write atomically. Raises ValueError for NaN, which JSON cannot hold."""
    write_file(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Raises BadInput where the file is missing or not JSON."""
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise BadInput(f"{path} is missing") from None
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise BadInput(f"{path} is damaged: it is not JSON") from None
