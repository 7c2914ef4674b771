"""How the C library hands out memory."""

import contextlib
import ctypes

# Parameters of glibc's mallopt.
TRIM_THRESHOLD = -1
MMAP_MAX = -4


def keep_freed_memory() -> None:
    """Reuse freed memory instead of handing it back to the system, which clears every page that it gives again.

    It changes the whole process, so that commands call it, not functions. At 1280 x 720 the clearing takes as long as a
    convolution of 32 to 32 channels. glibc only; elsewhere it does nothing.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(MMAP_MAX, 0)
        libc.mallopt(TRIM_THRESHOLD, 2**31 - 1)
