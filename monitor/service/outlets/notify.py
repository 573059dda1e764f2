"""People are told, through apprise (e-mail, webhooks, chat ...), and a watcher outside hears a heartbeat.

Observations come in on the monitor's thread; this module's own judges them, keeps them on the disk and delivers them.
A message that nobody takes is tried again for ever, after 1, 2, 4 .. 300 s, and outlasts restarts.  One that was taken when the
power went, before that was noted, comes again with the same number.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pydantic import Field

from monitor.core import WindowResult
from monitor.service.outlets import notices
from monitor.service.outlets.base import Outlet
from monitor.service.outlets.notices import NoticeSettings
from monitor.service.outlets.outbox import Message, Outbox

if TYPE_CHECKING:
    import apprise

_log = logging.getLogger(__name__)
_RETRY_S = (1.0, 300.0)
_TIMEOUT_S = 10.0
_MOST_SEEN = 256
_VARIABLE = re.compile(r"\$\{(\w+)\}")


class NotifySettings(NoticeSettings):
    """``[notify]`` of the site file; addresses hold secrets and are best kept out of it."""

    urls: tuple[str, ...] = Field(default=(), max_length=16)
    """apprise URLs; ``${NAME}`` is taken from the environment."""
    url_file: Path | None = None
    """A file with one such URL a line; relative to the site file."""
    heartbeat_url: str | None = None
    """Fetched every `heartbeat_s` while windows are produced; ``${NAME}`` as above."""
    heartbeat_s: float = Field(default=300.0, gt=0)
    """How often, at most."""
    most_per_hour: int = Field(default=60, ge=1)
    """Messages to one address; more wait."""


@dataclass(frozen=True, slots=True)
class Addresses:
    """Where to; never printed."""

    urls: tuple[str, ...] = field(default=(), repr=False)
    heartbeat_url: str | None = field(default=None, repr=False)


def addresses(settings: NotifySettings, folder: Path) -> Addresses:
    """The URLs, with environment and file read, each seen to be one; `folder` is the site file's.

    Raises
    ------
    ValueError
        One problem a line, without any part of a URL.
    """
    problems: list[str] = []
    named = [(f"urls[{k}]", url) for k, url in enumerate(settings.urls)]
    if settings.url_file is not None:
        try:
            text = (folder / settings.url_file).read_text(encoding="utf-8")
            rows = [(f"url_file line {k}", row.strip()) for k, row in enumerate(text.splitlines(), start=1)]
            named += [(place, row) for place, row in rows if row and not row.startswith("#")]
        except (OSError, UnicodeDecodeError) as error:
            problems.append(f"url_file: {settings.url_file}: {getattr(error, 'strerror', None) or 'not UTF-8 text'}")

    def filled(place: str, text: str) -> str:
        missing = [name for name in _VARIABLE.findall(text) if not os.environ.get(name)]
        problems.extend(f"{place}: the environment has no {name}" for name in missing)
        return "" if missing else _VARIABLE.sub(lambda match: os.environ[match[1]], text)

    urls = [(place, filled(place, url)) for place, url in named]
    problems += [f"{place}: no URL that apprise knows" for place, url in urls if url and _service(url) is None]
    beat = None if settings.heartbeat_url is None else filled("heartbeat_url", settings.heartbeat_url)
    if beat and not beat.startswith(("http://", "https://")):
        problems.append("heartbeat_url: no http:// or https:// URL")
    if problems:
        raise ValueError("\n".join(problems))
    return Addresses(tuple(dict.fromkeys(url for _, url in urls)), beat)


def _service(url: str) -> apprise.NotifyBase | None:
    import apprise

    logging.getLogger("apprise").setLevel(logging.CRITICAL + 1)  # it writes addresses
    asset = apprise.AppriseAsset(async_mode=False, app_id="shm-monitor", app_desc="structural health monitor")
    service = apprise.Apprise.instantiate(url, asset=asset, suppress_exceptions=True)
    return service if isinstance(service, apprise.NotifyBase) else None


class _Channel:
    """One address and how it fares."""

    def __init__(self, url: str) -> None:
        self.service = _service(url)
        self.key = hashlib.sha256(url.encode()).hexdigest()[:12]
        self.due_s = self.wait_s = 0.0
        self.failed = False
        self.sent_s: deque[float] = deque()

    @property
    def name(self) -> str:
        """The kind of service; nothing of the address."""
        return "" if self.service is None else str(self.service.service_name)


class Notifier(Outlet):
    """Send people a message when an alarm, the sensors' health or a finding changes.

    Parameters
    ----------
    site : str
        Named in each message.
    place : Path
        The outbox's file.
    clock : callable
        Seconds that only rise.
    """

    def __init__(
        self,
        site: str,
        settings: NotifySettings,
        to: Addresses,
        place: Path,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._site, self._place, self._clock = site, place, clock
        self._settings, self._to = settings, to
        self._channels: list[_Channel] = []
        self._stale = True
        self._trouble: str | None = None
        self._outbox: Outbox | None = None
        self._seen: deque[Callable[[Outbox], None]] = deque(maxlen=_MOST_SEEN)
        self._data_s = clock()
        self._beat_s, self._windows, self._beaten = float("-inf"), 0, 0
        self._changed = threading.Condition()
        self._closed = False
        self._thread: threading.Thread | None = None

    @property
    def failed(self) -> str | None:
        """Who cannot be reached, or why nothing is kept."""
        blocked = [f"{channel.name} not delivered" for channel in self._channels if channel.failed]
        return self._trouble or (self._outbox and self._outbox.failed) or "; ".join(blocked) or None

    @property
    def dropped(self) -> int:
        """Messages given up because too many waited."""
        return 0 if self._outbox is None else self._outbox.dropped

    def window(self, result: WindowResult, line: str) -> None:
        """See what alarms it changes."""
        self._windows += 1
        self._see(lambda outbox: self._note(outbox, *notices.of_window(outbox.told, result, self._settings)))

    def health_line(self, line: Mapping[str, Any]) -> None:
        """See whether source and recorder are at work."""
        now = self._clock()
        self._data_s = self._data_s if line["stream"] is None else now
        silent_s = now - self._data_s
        self._see(lambda outbox: self._note(outbox, *notices.of_health(outbox.told, line, silent_s, self._settings)))

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Tell what a diagnosis found."""
        self._see(lambda outbox: self._note(outbox, outbox.told, notices.of_finding(finding, self._settings)))

    def change(self, settings: NotifySettings, to: Addresses) -> None:
        """Go on with other settings; what waits for an address that is gone is dropped."""
        with self._changed:
            self._settings, self._to, self._stale = settings, to, True
            self._changed.notify_all()

    def close(self, timeout_s: float) -> None:
        """Try once more what waits; the rest is on the disk."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _see(self, look: Callable[[Outbox], None]) -> None:
        with self._changed:
            self._seen.append(look)
            if self._thread is None:  # not before: whoever is refused the folder has no business in it
                self._thread = threading.Thread(target=self._run, name="notify", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def _note(self, outbox: Outbox, told: notices.Told, found: Sequence[notices.Notice]) -> None:
        for notice in found:
            _log.warning("%s%s", notice.title, f": {notice.text}" if notice.text else "")
        outbox.add(told, found, [channel.key for channel in self._channels])

    def _run(self) -> None:
        outbox = self._outbox = Outbox(self._place)
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._seen or self._stale or self._closed, self._pause(outbox))
                seen, closed = list(self._seen), self._closed
                self._seen.clear()
            try:
                if self._stale:
                    self._stale = False
                    self._channels = [_Channel(url) for url in self._to.urls]
                    outbox.only(channel.key for channel in self._channels)
                for look in seen:
                    look(outbox)
                for channel in self._channels:
                    self._deliver(outbox, channel, closed=closed)
                self._beat()
                self._trouble = None
            except Exception as error:  # noqa: BLE001 - telling people never stops the monitor
                if self._trouble is None:
                    _log.error("notifications: %s", type(error).__name__)  # its text may hold an address
                self._trouble = type(error).__name__
            if closed:
                return

    def _pause(self, outbox: Outbox) -> float:
        """Seconds until there is something to do unasked."""
        waits = [channel.due_s - self._clock() for channel in self._channels if outbox.first(channel.key)]
        return max(0.05, min([10.0, *waits]))

    def _deliver(self, outbox: Outbox, channel: _Channel, *, closed: bool) -> None:
        while (message := outbox.first(channel.key)) is not None and (closed or self._clock() >= channel.due_s):
            now = self._clock()
            while channel.sent_s and now - channel.sent_s[0] >= 3600.0:
                channel.sent_s.popleft()
            if len(channel.sent_s) >= self._settings.most_per_hour:
                channel.due_s = channel.sent_s[0] + 3600.0
                return
            if not self._send(channel, message):
                channel.wait_s = min(max(_RETRY_S[0], 2.0 * channel.wait_s), _RETRY_S[1])
                channel.due_s = now + channel.wait_s
                if not channel.failed:
                    _log.error("notifications: %s takes nothing; %d wait", channel.name, len(outbox))
                channel.failed = True
                return
            channel.sent_s.append(now)
            channel.due_s = channel.wait_s = 0.0
            channel.failed = False
            outbox.delivered(message, channel.key)

    def _send(self, channel: _Channel, message: Message) -> bool:
        notice = message.notice
        body = f"{notice.text or notice.title}\n{message.when}, site {self._site}, message {message.id}"
        kind = "success" if notice.good else "warning"
        if channel.service is None:
            return False
        try:
            return bool(channel.service.notify(body=body, title=f"[{self._site}] {notice.title}", notify_type=kind))
        except Exception:  # noqa: BLE001 - a service's own troubles, of whatever kind; the text may hold an address
            return False

    def _beat(self) -> None:
        import urllib.request  # only a heartbeat needs it, and it loads TLS

        url, now = self._to.heartbeat_url, self._clock()
        if url is None or self._windows == self._beaten or now - self._beat_s < self._settings.heartbeat_s:
            return
        self._beat_s, self._beaten = now, self._windows
        try:
            with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as answer:  # http(s) only: see `addresses`
                answer.read(1024)
        except (OSError, ValueError) as error:
            _log.warning("heartbeat not heard: %s", type(error).__name__)
            self._beat_s = now - self._settings.heartbeat_s + min(60.0, self._settings.heartbeat_s)
            self._beaten = -1
