"""How the C library hands out memory."""

import contextlib
import ctypes

TRIM_THRESHOLD, MMAP_MAX = -1, -4  # of glibc's mallopt


def keep_freed_memory() -> None:
    """Reuse freed memory instead of handing it back to the system, which must clear every page that it gives again.

    At 1280 x 720 that clearing takes as long as a convolution of 32 to 32 channels. glibc only; elsewhere nothing.
    """
    with contextlib.suppress(OSError, AttributeError, TypeError):
        libc = ctypes.CDLL(None)
        libc.mallopt(MMAP_MAX, 0)
        libc.mallopt(TRIM_THRESHOLD, 2**31 - 1)
