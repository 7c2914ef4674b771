"""Small files written so that a reader never sees half of one."""

import json
import os
from pathlib import Path
from typing import Any

from errors import BadInput


def write_json(path: Path, content: Any) -> None:
    """Write atomically. Raises ValueError for NaN, which JSON cannot hold."""
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text)
    os.replace(temporary, path)


def read_json(path: Path) -> Any:
    """Raises BadInput where the file is missing or not JSON."""
    try:
        return json.loads(path.read_text())
    except FileNotFoundError:
        raise BadInput(f"{path} is missing") from None
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise BadInput(f"{path} is damaged: it is not JSON") from None
