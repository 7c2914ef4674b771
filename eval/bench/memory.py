"""Memory of a process, measured in separate processes."""

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
    gc.collect()
    with suppress(OSError, AttributeError):  # glibc only
        ctypes.CDLL(None).malloc_trim(0)


def growth_mb(run: Callable[[], object]) -> float | None:
    """Growth of resident memory while `run` is called, in MB; None where the system does not report it."""
    release_memory()  # memory that was freed but not returned would hide the growth
    try:
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
    except OSError:
        return None
    before = status_mb("VmRSS")
    run()
    peak = status_mb("VmHWM")
    return None if before is None or peak is None else max(0.0, peak - before)


def status_mb(field: str) -> float | None:
    """A field of /proc/self/status, such as VmRSS, in MB; None on systems other than Linux."""
    path = Path("/proc/self/status")
    match = re.search(rf"{field}:\s*(\d+) kB", path.read_text()) if path.exists() else None
    return int(match[1]) * 1024 / 1e6 if match else None


def alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of `function` in a new process that has imported only its module.

    The process exits normally: after one that is killed, as those of multiprocessing.Pool are, Python would report
    Numba's lock as leaked.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([function.__module__])  # imported once for all later calls
    # Without gc.freeze, collecting the imported modules would dominate small measurements.
    with ProcessPoolExecutor(1, mp_context=context, initializer=gc.freeze) as process:
        return process.submit(function, *arguments).result()
