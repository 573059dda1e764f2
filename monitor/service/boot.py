"""Time since the machine was started, on a clock that nobody sets and that goes on while the machine sleeps."""

from __future__ import annotations

import time
from pathlib import Path

_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


def boot_time() -> tuple[str, float]:
    """Return the kernel's identifier of this start of the machine, and the time since that start, s.

    The identifier is empty where the kernel gives none.
    """
    try:
        boot_id = _BOOT_ID.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        boot_id = ""
    return boot_id, time.clock_gettime(time.CLOCK_BOOTTIME)
