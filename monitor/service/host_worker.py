"""Process of a host's workers.

``python -m monitor.service.host_worker NUMBER COUNT metrics|no-metrics standby|alone SHARE SHARES PLACE...``
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import signal
import sys
import zlib
from pathlib import Path

from monitor.config import LogSettings
from monitor.core import UserError, keep_freed, single_blas_thread
from monitor.service import logs, systemd
from monitor.service.supervisor import Host, Policy

_PR_SET_PDEATHSIG = 1
"""Option of prctl(2). [1; definition]"""


def is_mine(path: Path, number: int, count: int) -> bool:
    """Return whether process `number` of `count` has a file of a folder, by its name alone: so no other file moves it.

    Examples
    --------
    >>> [is_mine(Path("a.toml"), k, 2) for k in (0, 1)]
    [True, False]
    """
    return zlib.crc32(path.name.encode()) % count == number


def is_of_share(path: Path, number: int, count: int) -> bool:
    """Return whether a site file is of share `number` of `count`, by its name alone, and whatever process has it.

    Examples
    --------
    >>> [is_of_share(Path("a.toml"), k, 2) for k in (1, 2)]
    [False, True]
    """
    # Another hash than that of the processes: else all sites of a share might be one process's.
    return int.from_bytes(hashlib.sha256(path.name.encode()).digest()) % count == number - 1


def main(arguments: list[str]) -> int:
    """Monitor this process's share of the sites, and return the exit code."""
    number, count, share, shares = map(int, (*arguments[:2], *arguments[4:6]))
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)  # where the parent is killed, the sites end in order
    logs.begin(LogSettings(), f"host {number}")
    keep_freed()
    metrics = ("127.0.0.1", 0) if arguments[2] == "metrics" else None
    try:
        policy = Policy(
            standby=arguments[3] == "standby",
            first=lambda path: is_of_share(path, share, shares),
            mine=lambda path: is_mine(path, number, count),
        )
        host = Host([Path(text) for text in arguments[6:]], policy, metrics, say=lambda _: None)
        if host.metrics is not None:
            systemd.notify(f"X_METRICS_PORT={host.metrics.port}")
        with single_blas_thread():
            host.run()
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    code = main(sys.argv[1:])
    sys.stderr.flush()
    # A thread that still waits for a disk would abort the process if it returned while the interpreter ends.
    os._exit(code)
