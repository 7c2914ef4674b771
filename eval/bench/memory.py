"""Peak memory, measured in processes of their own."""

import ctypes
import gc
import multiprocessing
import re
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from allocator import keep_freed_memory


def release() -> None:
    """Hand memory that nobody needs any more back to the system."""
    gc.collect()
    with suppress(OSError, AttributeError):  # glibc only
        ctypes.CDLL(None).malloc_trim(0)


def growth_mb(run: Callable[[], object]) -> float | None:
    """How far resident memory rises while `run` is called, in MB; Linux only, else None."""
    release()  # or the rise would fit unseen into what was freed
    try:
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    except OSError:
        return None
    before = status_mb("VmRSS")
    run()
    return max(0.0, status_mb("VmHWM") - before)


def status_mb(field: str) -> float:
    match = re.search(rf"{field}:\s*(\d+) kB", Path("/proc/self/status").read_text())
    assert match
    return int(match[1]) * 1024 / 1e6


def alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """What `function` returns in a process that has done nothing yet but import its module."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([function.__module__])  # imported once for all that follow
    with context.Pool(1, keep_freed_memory) as process:
        return process.apply(function, arguments)
