"""Outlet of the web page: gives what is published to the page's snapshots, and serves them in threads of its own."""

from __future__ import annotations

import logging
import sys
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from monitor.core import WindowResult, parse_json
from monitor.damage import Assessment
from monitor.events import Event
from monitor.service.outlets.base import Outlet
from monitor.service.outlets.http_server import Bounds, HttpServer, asgi
from monitor.service.threads import Chores
from monitor.service.web.application import make_application
from monitor.service.web.snapshots import Snapshots, latest_events, latest_windows

_log = logging.getLogger(__name__)
LEAST_TOKEN = 16
"""Least number of characters of a token, which then cannot be guessed at the rate of requests. [1; judgement]"""
_BOUNDS = Bounds(connections=32, per_s=50.0, connection_s=10.0, waiting=128)
"""What readers may cost: a page makes ten requests when it is opened, then one every five seconds. [none; judgement]"""
_MOST_SUMMARY_BYTES = 16 << 20
"""Largest size of a summary.json that is read. [B; judgement]"""


def read_token(path: Path) -> str:
    """Read the token of the page; ValueError, which names the file, tells that it cannot be read or holds none."""
    try:
        token = path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {getattr(error, 'strerror', None) or 'it is no text'}") from error
    if len(token) < LEAST_TOKEN or not (token.isascii() and token.isprintable()) or " " in token:
        raise ValueError(
            f"{path}: a token is one word of at least {LEAST_TOKEN} letters, digits or signs; make one with: openssl rand -hex 24"
        )
    return token


class WebPage(Outlet):
    """Serve the page; no method but `close` waits, and none raises.

    If the port cannot be opened, `failed` says so, and every health line triggers another attempt; `url` is None until it
    listens.  The past is read from the output folder.  `most_waiting` results wait for the page's thread: an hour of windows a
    second.
    """

    dropped: int = 0

    def __init__(
        self, site: str, address: tuple[str, int], token: str | None, out: Path, most_waiting: int = 4096
    ) -> None:
        self._out, self._most_waiting = out, most_waiting
        self.url: str | None = None
        self._host, self._port = address
        self._failure: str | None = None
        self._snapshots = Snapshots(site)
        self._application = make_application(self._snapshots, token)
        self._server: HttpServer | None = None
        self._waiting: deque[Callable[[], None]] = deque()
        self._worker, self._files = Chores("web-results"), Chores("web-files")
        self._files.do("past", self._read_past)
        self._listen()

    @property
    def failed(self) -> str | None:
        """Why the page cannot be read, or is not up to date; None if it is."""
        return self._failure or self._worker.failed or self._files.failed

    def state(self, assessment: Assessment) -> None:
        """Show the present state of the structure."""
        super().state(assessment)
        self._show(partial(self._snapshots.state, assessment))

    def window(self, result: WindowResult, line: str) -> None:
        """Show a window."""
        self._show(lambda: self._snapshots.window(parse_json(line)))

    def event(self, event: Event, line: str) -> None:
        """Show an event."""
        self._show(lambda: self._snapshots.event(parse_json(line)))

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Show the finding of a diagnosis."""
        self._show(partial(self._snapshots.finding, finding))

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Show the health; listen if the port is not open."""
        self._show(partial(self._snapshots.health, line))
        if self._server is None:
            self._listen()

    def summary(self, content: Mapping[str, Any]) -> None:
        """Show the alarms, and what else the summary holds."""
        self._show(partial(self._snapshots.summary, content))

    def close(self, timeout_s: float) -> None:
        """Stop listening."""
        if self._server is not None:
            self._server.close(timeout_s)
        for worker in (self._worker, self._files):
            worker.close(0.0)  # they only read, and need not end

    def _show(self, job: Callable[[], None]) -> None:
        """Queue what changes the snapshots, for the page's own thread."""
        if len(self._waiting) >= self._most_waiting:
            self.dropped += 1
            return
        self._waiting.append(job)
        self._worker.do("results", self._take)

    def _take(self) -> None:
        while self._waiting:
            self._waiting.popleft()()

    def _read_past(self) -> None:
        """Read what earlier runs left (in a thread that may wait for the disk)."""
        content = None
        with suppress(OSError, ValueError), (self._out / "summary.json").open("rb") as file:
            content = parse_json(file.read(_MOST_SUMMARY_BYTES))
        if isinstance(content, dict):
            self._snapshots.summary(content)
        self._snapshots.windows_before(latest_windows(self._out))
        for line in latest_events(self._out):
            self._snapshots.event(line)

    def _listen(self) -> None:
        """Start the server; a failure is kept in `failed` and logged once."""
        host = f"[{self._host}]" if ":" in self._host else self._host
        try:
            self._server = HttpServer(self._host, self._port, asgi(self._application), bounds=_BOUNDS)
        except OSError as error:
            if self._failure is None:
                _log.error("no web page at %s:%d for now: %s", host, self._port, error)
            self._failure = f"{host}:{self._port}: {error}"
            return
        self._failure = None
        self.url = f"http://{host}:{self._server.port}/"
        print(f"web page at {self.url}", file=sys.stderr, flush=True)
