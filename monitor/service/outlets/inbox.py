"""Operators' requests as files of a folder: only users who may write into the folder can make requests."""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import stat
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path

from pydantic import ValidationError

from drivers.disk import PRIVATE_FOLDER
from monitor.core import finish, partial, settings_problems, write_atomically
from monitor.service.outlets.base import Outlet
from monitor.service.requests import MAX_REQUEST_BYTES, Answer, RateLimit, Request
from monitor.service.threads import Chores

_log = logging.getLogger(__name__)
_MOST = 64
_REFUSED = ".refused"


class Inbox(Outlet):
    """Read the operators' requests from a folder, by default at most twice a second.

    A file is removed only after its request was applied, so that a request interrupted by a power cut is applied again.
    Applying a request twice has the same effect as once, because every request states the wanted result.  Why one was refused
    stands in a file of the same name, which who asked takes away (`take_refusal`).  A request that
    cannot be applied yet, or exceeds the rate of its asker, waits.  One whose file cannot be removed is applied once in a run.
    Files are read and removed in the thread of `worker`, so that `take_requests` waits for no disk; without one they are at once.
    """

    def __init__(
        self,
        folder: Path,
        clock: Callable[[], float] = time.monotonic,
        worker: Chores | None = None,
        every_s: float = 0.5,
    ) -> None:
        self._folder, self._clock, self._worker, self._every_s = folder, clock, worker, every_s
        self._polled_s = float("-inf")
        self._limit = RateLimit(clock)
        self._looking = False
        self._found: list[tuple[Path, Request]] = []
        """Requests that were read and wait to be taken."""
        self._taken: list[Path] = []
        self._done: deque[tuple[Path, str | None]] = deque()
        """Files of answered requests, and why each was refused."""
        self._stuck: set[Path] = set()
        with contextlib.suppress(OSError):  # created here, so that the daemon's user owns it, whoever asks first
            folder.mkdir(PRIVATE_FOLDER, parents=True, exist_ok=True)

    @property
    def failed(self) -> str | None:
        """Words that say that the folder's disk does not answer; None while it does."""
        return None if self._worker is None else self._worker.failed

    def take_requests(self) -> Sequence[Request]:
        """Return the requests that were read; the folder is looked at again if none waits."""
        now = self._clock()
        if not self._found and not self._looking and now - self._polled_s >= self._every_s:
            self._polled_s, self._looking = now, True
            self._run("look", self._look)
        if self._looking:
            return ()
        found, self._found = self._found, []
        self._taken = [path for path, _ in found]
        return [request for _, request in found]

    def answer_requests(self, answers: Sequence[Answer]) -> None:
        """Remove the files of the requests, but for those that may be applied later; a refusal is left in the place of one."""
        answered = zip(self._taken, answers, strict=True)
        self._done += [(path, answer.refusal) for path, answer in answered if not answer.again]
        self._taken = []
        if self._done:
            self._run("remove", self._remove_done)

    def close(self, timeout_s: float) -> None:
        """Remove the files of the requests that were answered, for at most `timeout_s`."""
        if self._worker is not None:
            self._worker.close(timeout_s)

    def _run(self, name: str, job: Callable[[], None]) -> None:
        """Do a job in the worker's thread; without a worker at once."""
        if self._worker is None:
            job()
        else:
            self._worker.do(name, job)

    def _look(self) -> None:
        """Read the requests that wait; files that are none are removed."""
        try:
            files = {self._folder / name for name in os.listdir(self._folder) if name.endswith(".json")}
            self._stuck &= files
            for path in sorted(files - self._stuck)[:_MOST]:
                request = _read(path)
                if request is None:
                    self._remove(path)
                elif self._limit.refusal(request.who) is None:
                    self._found.append((path, request))
        except OSError:
            return
        finally:
            self._looking = False

    def _remove_done(self) -> None:
        """Remove the files of answered requests; of the refusals that nobody took the latest are kept."""
        while self._done:
            path, refusal = self._done.popleft()
            if refusal is not None:
                _leave_refusal(path, refusal)
                for old in sorted(self._folder.glob(f"*{_REFUSED}"))[:-_MOST]:
                    self._remove(old)
            self._remove(path)

    def _remove(self, path: Path) -> None:
        """Remove a file; one that stays is not read again."""
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            self._stuck.add(path)
            _log.error("%s was dealt with and cannot be removed: %s; remove it", path, error.strerror or error)


def leave_request(folder: Path, request: Request) -> Path:
    """Write a request into the folder and return its file, which the daemon removes once the request is applied.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    if not folder.is_dir():
        folder.mkdir(PRIVATE_FOLDER, parents=True, exist_ok=True)
        _set_owner(folder, folder.parent)
    place = folder / f"{time.time_ns()}-{secrets.token_hex(4)}.json"  # names sort in the order of the requests
    temporary = partial(place)
    temporary.write_text(request.model_dump_json(), encoding="utf-8")
    temporary.chmod(0o644)  # access is controlled by the folder's permissions
    _set_owner(temporary, folder)
    finish(place)
    return place


def _leave_refusal(request: Path, refusal: str) -> None:
    """Tell, beside the file of a request, why it was refused; on a full disk that it was."""
    place = _refusal_of(request)
    try:
        write_atomically(place, refusal)
        place.chmod(0o644)  # access is controlled by the folder's permissions
    except OSError as error:
        _log.warning("%s: cannot be written: %s", place, error.strerror or error)
        with contextlib.suppress(OSError):
            os.replace(request, place)


def take_refusal(request: Path) -> str | None:
    """Take the reason for which the request of a file that is gone was refused; None if it was not."""
    place = _refusal_of(request)
    try:
        refusal = place.read_text(encoding="utf-8")
        with contextlib.suppress(OSError):  # the daemon removes it in time
            place.unlink()
    except FileNotFoundError:
        return None
    except OSError as error:
        return f"{place}, which says why, cannot be read: {error.strerror or error}"
    return refusal


def _refusal_of(request: Path) -> Path:
    """Return the file in which the refusal of a request is told."""
    return request.with_suffix(_REFUSED)


def _set_owner(path: Path, like: Path) -> None:
    """Give `path` the owner of `like`, so that the daemon's user can read and remove what root has written."""
    owner = like.stat()
    with contextlib.suppress(PermissionError):
        os.chown(path, owner.st_uid, owner.st_gid)


def _read(path: Path) -> Request | None:
    """Read a request from a file; None, with the reason logged, if it holds none."""
    try:
        # No link, which could lead outside the folder, and no pipe, on which reading would wait for ever.
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
