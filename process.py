"""Settings of a whole process, which commands and their workers make and no function of the library does."""

import contextlib
import ctypes
import os

# Parameters of glibc's mallopt.
TRIM_THRESHOLD = -1
MMAP_MAX = -4


def set_up_process() -> None:
    """Keep freed memory, and let waiting threads sleep. Call it before PyTorch is imported."""
    keep_freed_memory()
    wait_passively()


def keep_freed_memory() -> None:
    """Reuse freed memory instead of returning it to the system, which clears every page that it hands out again.

    At 1280 x 720 the clearing takes as long as a convolution of 32 to 32 channels. glibc only, else without effect.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(MMAP_MAX, 0)
        libc.mallopt(TRIM_THRESHOLD, 2**31 - 1)


def wait_passively() -> None:
    """Let OpenMP threads sleep while they wait for each other, unless the user has set OMP_WAIT_POLICY.

    By default they spin, and where another process is busy they spin for the time slices of the thread that they wait
    for: a training step on two busy cores then takes many times as long.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
