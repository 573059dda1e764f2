"""Operators' requests as files of a folder: whoever may write there may ask, and nobody else."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import stat
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from monitor.files import write_atomically
from monitor.publish.requests import MAX_REQUEST_BYTES, Request
from monitor.results import Gap, WindowResult

_log = logging.getLogger(__name__)
_EVERY_S = 0.5
_MOST = 64


class Inbox:
    """Reads the folder now and then (`monitor.outlets.Outlet`).

    A file is removed only after what it asked for was applied: what a power cut interrupts is done again, and all requests say
    how things shall be, so twice is as once.
    """

    failed: str | None = None

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._looked_s = float("-inf")
        self._done: list[Path] = []

    def take_requests(self) -> Sequence[Request]:
        """Those that came since; what was handed out before counts as applied."""
        for path in self._done:
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        self._done = []
        now = time.monotonic()
        if now - self._looked_s < _EVERY_S:
            return ()
        self._looked_s = now
        try:
            names = sorted(name for name in os.listdir(self._folder) if name.endswith(".json"))
        except OSError:
            return ()  # nobody has asked anything yet
        self._done = [self._folder / name for name in names[:_MOST]]
        return [request for path in self._done if (request := _read(path)) is not None]

    def window(self, result: WindowResult, line: str) -> None:
        """Of no use here, as all of these."""

    def gap(self, gap: Gap) -> None:
        """Of no use here."""

    def health(self, health: Mapping[str, Any]) -> None:
        """Of no use here."""

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Of no use here."""

    def close(self, timeout_s: float) -> None:
        """What was applied goes; what comes now is for the next run."""
        self._looked_s = float("inf")
        self.take_requests()


def ask(folder: Path, request: Request) -> Path:
    """Put a request into the folder; the file is gone when it was applied.

    Raises ``OSError`` if it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / f"{time.time_ns()}-{secrets.token_hex(4)}.json"  # in the order in which they were asked
    write_atomically(place, request.model_dump_json())
    return place


def _read(path: Path) -> Request | None:
    try:
        # Neither a link nor a pipe: the one leads elsewhere, the other would wait for ever.
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        with open(handle, "rb") as file:
            if not stat.S_ISREG(os.fstat(handle).st_mode):
                raise ValueError("not a file")
            data = file.read(MAX_REQUEST_BYTES + 1)
        if len(data) > MAX_REQUEST_BYTES:
            raise ValueError(f"more than {MAX_REQUEST_BYTES} bytes")
        return Request.model_validate_json(data)
    except ValidationError as error:
        _log.warning("%s: no request: %s", path.name, error.errors()[0]["msg"])
    except (OSError, ValueError) as error:
        _log.warning("%s: no request: %s", path.name, error)
    return None
