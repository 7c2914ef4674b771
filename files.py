"""Small files, written so that a reader never gets a part of one."""

import csv
import fcntl
import io
import json
import os
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from errors import BadInput


def crc32_of(path: Path) -> str:
    """The checksum of a file, 8 hex digits."""
    return f"{zlib.crc32(path.read_bytes()):08x}"


def cache_folder() -> Path:
    """Where what was measured of this machine is kept from process to process; it need not exist."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "onespp"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary path that replaces `path` at the end, or not at all if an exception is raised."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")  # of this process: others may write the same file
    try:
        yield temporary
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_file(path: Path, content: bytes) -> None:
    """Write atomically. Raises OSError, on a full disk too."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_json(path: Path, content: Any) -> None:
    """Write atomically. Raises ValueError for NaN, which JSON cannot hold."""
    write_file(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write atomically; None becomes an empty cell."""
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    write_file(path, text.getvalue().encode())


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
def locked(lock: Path) -> Iterator[bool]:
    """Hold the lock file `lock` until the end, then remove it. Yields False if another process has it.

    The system releases the lock of a process that dies, so a file left behind does no harm.
    """
    with lock.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            ours = lock.stat().st_ino == os.fstat(file.fileno()).st_ino  # else its last owner has just removed it
        except (BlockingIOError, FileNotFoundError):
            ours = False
        try:
            yield ours
        finally:
            if ours:
                lock.unlink(missing_ok=True)
