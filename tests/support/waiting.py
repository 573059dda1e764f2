"""Wait for what other threads and processes do, and read the files that they write."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE_S = 90.0


def until(is_so: Callable[[], object], what: str, patience_s: float = PATIENCE_S) -> None:
    """Wait; fails after `patience_s`."""
    deadline = time.monotonic() + patience_s
    while not is_so():
        assert time.monotonic() < deadline, f"not within {patience_s:g} s: {what}"
        time.sleep(0.01)
