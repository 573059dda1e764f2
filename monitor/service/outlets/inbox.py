"""Operators' requests as files of a folder: whoever may write there may ask, and nobody else."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import stat
import time
from collections.abc import Sequence
from pathlib import Path

from pydantic import ValidationError

from monitor.core import finish, partial, settings_problems
from monitor.service.outlets.base import Outlet
from monitor.service.requests import MAX_REQUEST_BYTES, Request

_log = logging.getLogger(__name__)
_EVERY_S = 0.5
_MOST = 64


class Inbox(Outlet):
    """Read the operators' requests from a folder, twice a second at most.

    A file is removed only after what it asked for was applied: what a power cut interrupts is done again, and all requests say
    how things shall be, so twice is as once.  One that cannot be removed is applied once in a run.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._looked_s = float("-inf")
        self._done: list[Path] = []
        self._stuck: set[Path] = set()
        with contextlib.suppress(OSError):  # so that it is the daemon's, whoever asks first
            folder.mkdir(parents=True, exist_ok=True)

    def take_requests(self) -> Sequence[Request]:
        """Those that came since; what was handed out before counts as applied."""
        for path in self._done:
            try:
                path.unlink(missing_ok=True)
            except OSError as error:
                self._stuck.add(path)
                _log.error("%s was applied and cannot be removed: %s; remove it", path, error.strerror or error)
        self._done = []
        now = time.monotonic()
        if now - self._looked_s < _EVERY_S:
            return ()
        self._looked_s = now
        try:
            asked = {self._folder / name for name in os.listdir(self._folder) if name.endswith(".json")}
        except OSError:
            return ()
        self._stuck &= asked
        self._done = sorted(asked - self._stuck)[:_MOST]
        return [request for path in self._done if (request := _read(path)) is not None]

    def close(self, timeout_s: float) -> None:
        """What was applied goes; what comes now is for the next run."""
        self._looked_s = float("inf")
        self.take_requests()


def leave_request(folder: Path, request: Request) -> Path:
    """Put a request into the folder; the file is gone when it was applied.

    Raises ``OSError`` if it cannot be written.
    """
    if not folder.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        _give(folder, folder.parent)
    place = folder / f"{time.time_ns()}-{secrets.token_hex(4)}.json"  # in the order in which they were asked
    made = partial(place)
    made.write_text(request.model_dump_json(), encoding="utf-8")
    made.chmod(0o644)  # the folder says who may
    _give(made, folder)
    finish(place)
    return place


def _give(path: Path, like: Path) -> None:
    """What root asks, the daemon's user must be able to read and remove."""
    owner = like.stat()
    with contextlib.suppress(PermissionError):
        os.chown(path, owner.st_uid, owner.st_gid)


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
        _log.warning("%s: no request: %s", path.name, "; ".join(settings_problems(error)))
    except (OSError, ValueError) as error:
        _log.warning("%s: no request: %s", path.name, error)
    return None
