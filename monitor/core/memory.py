"""Memory management of the process."""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
"""Numbers of glibc's mallopt(3)."""


def keep_freed() -> None:
    """Let the C library keep freed memory for later arrays, instead of requesting it page by page for every window.

    The requests took a quarter of the time before identification.  At most 64 MiB are kept; without glibc nothing is done.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    for option, size in ((_MMAP_THRESHOLD, 32 << 20), (_TRIM_THRESHOLD, 64 << 20), (_TOP_PAD, 16 << 20)):
        mallopt(option, size)
