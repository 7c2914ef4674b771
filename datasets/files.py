"""Small files written so that a reader never sees half of one."""

import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from errors import BadInput


def write_file(path: Path, content: bytes) -> None:
    """Write atomically: whatever fails, what stood at `path` before still does. Raises OSError, on a full disk too."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")  # of this process: others may write the same file
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Write atomically. Raises ValueError for NaN, which JSON cannot hold."""
    write_file(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path, keys: Sequence[str] = ()) -> dict[str, Any]:
    """Raises BadInput where the file is missing, or is not a JSON object with all `keys`."""
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError:
        raise BadInput(f"{path} is missing") from None
    except (json.JSONDecodeError, UnicodeDecodeError):
        raise BadInput(f"{path} is damaged: it is not JSON") from None
    if not isinstance(content, dict) or not all(key in content for key in keys):
        raise BadInput(f"{path} is damaged: it lacks {' or '.join(keys)}")
    return content


@contextmanager
def locked(folder: Path, doing: str) -> Iterator[None]:
    """Hold a folder's lock. Raises BadInput where another process is `doing` something there."""
    with (folder / ".lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadInput(f"another process is {doing} {folder}: wait for it or use another folder") from None
        yield
