"""How the process holds its memory."""

from __future__ import annotations

import ctypes

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
"""Numbers of glibc's mallopt(3)."""


def keep_freed() -> None:
    """Let the C library keep what arrays leave behind for the next ones, instead of fetching it page by page for every window.

    A quarter of the time before identification went into that.  At most 64 MiB are kept; does nothing without glibc.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return
    for option, size in ((_MMAP_THRESHOLD, 32 << 20), (_TRIM_THRESHOLD, 64 << 20), (_TOP_PAD, 16 << 20)):
        mallopt(option, size)
