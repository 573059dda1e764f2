"""Outlet of the web page: gives what is published to the page's snapshots, and serves them in threads of its own."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from monitor.core import BoundedQueue, Full, WindowResult, Work, Worker, parse_json
from monitor.damage import Assessment
from monitor.events import Event
from monitor.service.outlets.base import Outlet
from monitor.service.outlets.http_server import Bounds, HttpServer
from monitor.service.web.application import make_application
from monitor.service.web.snapshots import Snapshots, latest_events, latest_windows

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

    Every health line tries to open the port again where that failed; `url` is None until it listens.  The past is read from the
    output folder.  `most_waiting` results wait for the page's thread: an hour of windows a second.
    """

    def __init__(
        self, site: str, address: tuple[str, int], token: str | None, out: Path, most_waiting: int = 4096
    ) -> None:
        self._out, self._snapshots = out, Snapshots(site)
        self._server = HttpServer("web page", address, make_application(self._snapshots, token), bounds=_BOUNDS)
        queue = BoundedQueue[Callable[[], None]](most_waiting, full=Full.REFUSE)
        self._worker = Worker("web-results", Work(lambda job: job()), queue)
        self._files: Worker[None] = Worker("web-files", Work(idle=self._read_past))
        for worker in (self._worker, self._files):
            worker.start()
        self._listen()

    @property
    def url(self) -> str | None:  # type: ignore[override]
        """Address of the page."""
        return None if self._server.port is None else f"http://{self._server.at}/"

    @property
    def failed(self) -> str | None:
        """Why the page cannot be read, or is not up to date; None if it is."""
        return self._server.failed or self._worker.failed or self._files.failed

    @property
    def dropped(self) -> int:
        """Number of results that found no room."""
        return self._worker.dropped

    def state(self, assessment: Assessment) -> None:
        """Show the present state of the structure."""
        super().state(assessment)
        self._worker.put(partial(self._snapshots.state, assessment))

    def window(self, result: WindowResult, line: str) -> None:
        """Show a window."""
        self._worker.put(lambda: self._snapshots.window(parse_json(line)))

    def event(self, event: Event, line: str) -> None:
        """Show an event."""
        self._worker.put(lambda: self._snapshots.event(parse_json(line)))

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Show the finding of a diagnosis."""
        self._worker.put(partial(self._snapshots.finding, finding))

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Show the health; listen if the port is not open."""
        self._worker.put(partial(self._snapshots.health, line))
        self._listen()

    def summary(self, content: Mapping[str, Any]) -> None:
        """Show the alarms, and what else the summary holds."""
        self._worker.put(partial(self._snapshots.summary, content))

    def close(self, timeout_s: float) -> None:
        """Stop listening."""
        self._server.close(timeout_s)
        for worker in (self._worker, self._files):
            worker.ask_to_end(at_once=True)  # they only read, and need not end

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
        if self._server.open():
            print(f"web page at {self.url}", file=sys.stderr, flush=True)
