"""Memory that a process takes, measured in processes of their own."""

import ctypes
import gc
import multiprocessing
import re
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any


def release_memory() -> None:
    """Hand memory that nobody needs any more back to the system."""
    gc.collect()
    with suppress(OSError, AttributeError):  # glibc only
        ctypes.CDLL(None).malloc_trim(0)


def growth_mb(run: Callable[[], object]) -> float | None:
    """How far resident memory rises while `run` is called, in MB; None where the system does not tell."""
    release_memory()  # or the rise would fit unseen into what was freed
    try:
        Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    except OSError:
        return None
    before = status_mb("VmRSS")
    run()
    peak = status_mb("VmHWM")
    return None if before is None or peak is None else max(0.0, peak - before)


def status_mb(field: str) -> float | None:
    """A field of /proc/self/status, such as VmRSS, in MB; None where the system does not tell: only Linux does."""
    path = Path("/proc/self/status")
    match = re.search(rf"{field}:\s*(\d+) kB", path.read_text()) if path.exists() else None
    return int(match[1]) * 1024 / 1e6 if match else None


def alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """What `function` returns in a process that has done nothing yet but import its module.

    The process ends by itself. One that is killed, as those of a multiprocessing.Pool are, cannot clean up: of Numba's
    lock, at the latest, Python would say at the end that it has leaked.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([function.__module__])  # imported once for all that follow
    # What was imported stays: to go through all of it would take most of the time of a small measurement.
    with ProcessPoolExecutor(1, mp_context=context, initializer=gc.freeze) as process:
        return process.submit(function, *arguments).result()
