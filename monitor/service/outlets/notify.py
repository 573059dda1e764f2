"""Notifications to people through apprise (e-mail, webhooks, chat ...), and a heartbeat to an external supervisor.

Observations arrive on the monitor's thread.  A separate thread derives messages from them, stores the messages on the disk and
delivers them.  An undelivered message is tried again without end, after 1, 2, 4 .. 300 s, and survives restarts.  A message
that was delivered just before a power cut, so that its delivery was not recorded, is sent again with the same number.
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
_MOST_OBSERVATIONS = 256
_VARIABLE = re.compile(r"\$\{(\w+)\}")


class NotifySettings(NoticeSettings):
    """``[notify]`` of the site file; addresses hold secrets and are best kept out of it."""

    urls: tuple[str, ...] = Field(default=(), max_length=16)
    """apprise URLs; ``${NAME}`` is replaced by the environment variable NAME."""
    url_file: Path | None = None
    """File with one such URL a line; relative to the site file."""
    heartbeat_url: str | None = None
    """URL that is fetched every `heartbeat_s` while windows are produced, with the ledger's head as ``ledger=HASH`` in its query;
    ``${NAME}`` as in `urls`."""
    heartbeat_s: float = Field(default=300.0, gt=0)
    """Shortest time from one heartbeat to the next."""
    most_per_hour: int = Field(default=60, ge=1)
    """Largest number of messages to one address in an hour; further messages wait."""


@dataclass(frozen=True, slots=True)
class Addresses:
    """Resolved addresses of the notifications; never printed, because they hold secrets."""

    urls: tuple[str, ...] = field(default=(), repr=False)
    heartbeat_url: str | None = field(default=None, repr=False)


def addresses(settings: NotifySettings, folder: Path) -> Addresses:
    """Resolve the URLs of the settings: read the environment and the URL file, and check every URL.

    Parameters
    ----------
    settings : NotifySettings
        Settings of ``[notify]``.
    folder : Path
        Folder of the site file.

    Raises
    ------
    ValueError
        The addresses are invalid; the message lists one problem a line, without any part of a URL.
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

    def expanded(place: str, text: str) -> str:
        missing = [name for name in _VARIABLE.findall(text) if not os.environ.get(name)]
        problems.extend(f"{place}: the environment has no {name}" for name in missing)
        return "" if missing else _VARIABLE.sub(lambda match: os.environ[match[1]], text)

    urls = [(place, expanded(place, url)) for place, url in named]
    problems += [f"{place}: no URL that apprise knows" for place, url in urls if url and _service(url) is None]
    heartbeat = None if settings.heartbeat_url is None else expanded("heartbeat_url", settings.heartbeat_url)
    if heartbeat and not heartbeat.startswith(("http://", "https://")):
        problems.append("heartbeat_url: no http:// or https:// URL")
    if problems:
        raise ValueError("\n".join(problems))
    return Addresses(tuple(dict.fromkeys(url for _, url in urls)), heartbeat)


def _service(url: str) -> apprise.NotifyBase | None:
    """Create apprise's service for a URL; None if apprise does not know it."""
    import apprise

    logging.getLogger("apprise").setLevel(logging.CRITICAL + 1)  # it logs addresses, which hold secrets
    asset = apprise.AppriseAsset(async_mode=False, app_id="shm-monitor", app_desc="structural health monitor")
    service = apprise.Apprise.instantiate(url, asset=asset, suppress_exceptions=True)
    return service if isinstance(service, apprise.NotifyBase) else None


class _Channel:
    """Delivery to one address: its service, its retries and its recent messages."""

    def __init__(self, url: str) -> None:
        self.service = _service(url)
        self.key = hashlib.sha256(url.encode()).hexdigest()[:12]
        self.due_s = self.wait_s = 0.0
        self.failed = False
        self.sent_s: deque[float] = deque()

    @property
    def name(self) -> str:
        """Kind of the service, without any part of the address."""
        return "" if self.service is None else str(self.service.service_name)


def _with_head(url: str, head: str | None) -> str:
    """Add the ledger's head to the query of a heartbeat's URL, so that whoever hears it can later tell a changed ledger."""
    bare, mark, fragment = url.partition("#")
    return url if head is None else f"{bare}{'&' if '?' in bare else '?'}ledger={head}{mark}{fragment}"


class Notifier(Outlet):
    """Send people a message when the state of the structure, the sensors' health or a finding changes.

    Parameters
    ----------
    site : str
        Name of the site, given in each message.
    settings : NotifySettings
        Settings of ``[notify]``.
    to : Addresses
        Resolved addresses.
    place : Path
        File of the outbox.
    clock : callable
        Monotonic clock, s.
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
        self._channels_outdated = True
        self._error: str | None = None
        self._outbox: Outbox | None = None
        self._observations: deque[Callable[[Outbox], None]] = deque(maxlen=_MOST_OBSERVATIONS)
        self._data_s = clock()
        self._ledger_head: str | None = None
        self._heartbeat_sent_s, self._windows, self._heartbeat_windows = float("-inf"), 0, 0
        self._changed = threading.Condition()
        self._closed = False
        self._thread: threading.Thread | None = None

    @property
    def failed(self) -> str | None:
        """Services that cannot be reached, or why messages cannot be stored; None if all is well."""
        blocked = [f"{channel.name} not delivered" for channel in self._channels if channel.failed]
        return self._error or (self._outbox and self._outbox.failed) or "; ".join(blocked) or None

    @property
    def dropped(self) -> int:
        """Number of messages given up because too many waited."""
        return 0 if self._outbox is None else self._outbox.dropped

    def window(self, result: WindowResult, line: str) -> None:
        """Announce alarms that the window raises, escalates or clears, and long times without a judged window."""
        self._windows += 1
        present = self.present
        self._observe(
            lambda outbox: self._add_notices(outbox, *notices.of_window(outbox.told, result, present, self._settings))
        )

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Announce changes of the source's and the recorder's state."""
        now, self._ledger_head = self._clock(), line.get("ledger_head")
        self._data_s = self._data_s if line["stream"] is None else now
        silent_s = now - self._data_s
        self._observe(
            lambda outbox: self._add_notices(outbox, *notices.of_health(outbox.told, line, silent_s, self._settings))
        )

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Announce the finding of a diagnosis."""
        present = self.present
        self._observe(
            lambda outbox: self._add_notices(outbox, *notices.of_finding(outbox.told, finding, present, self._settings))
        )

    def change(self, settings: NotifySettings, to: Addresses) -> None:
        """Replace settings and addresses; messages that wait for a removed address are dropped."""
        with self._changed:
            self._settings, self._to, self._channels_outdated = settings, to, True
            self._changed.notify_all()

    def close(self, timeout_s: float) -> None:
        """Try once more to deliver the messages that wait; the others stay on the disk."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _observe(self, observation: Callable[[Outbox], None]) -> None:
        with self._changed:
            self._observations.append(observation)
            # Not started earlier, so that a daemon that may not use the folder does not touch it.
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="notify", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def _add_notices(self, outbox: Outbox, told: notices.Told, found: Sequence[notices.Notice]) -> None:
        """Log notices and queue them for every address."""
        for notice in found:
            _log.warning("%s%s", notice.title, f": {notice.text}" if notice.text else "")
        outbox.add(told, found, [channel.key for channel in self._channels])

    def _run(self) -> None:
        """Process observations and deliver messages until closed (the thread's work)."""
        outbox = self._outbox = Outbox(self._place)
        while True:
            with self._changed:
                self._changed.wait_for(
                    lambda: self._observations or self._channels_outdated or self._closed, self._pause(outbox)
                )
                observations, closed = list(self._observations), self._closed
                self._observations.clear()
            try:
                if self._channels_outdated:
                    self._channels_outdated = False
                    self._channels = [_Channel(url) for url in self._to.urls]
                    outbox.only(channel.key for channel in self._channels)
                for observation in observations:
                    observation(outbox)
                for channel in self._channels:
                    self._deliver(outbox, channel, closed=closed)
                self._send_heartbeat()
                self._error = None
            except Exception as error:  # noqa: BLE001 - a failing notification never stops the monitor
                if self._error is None:
                    _log.error("notifications: %s", type(error).__name__)  # its text may hold an address
                self._error = type(error).__name__
            if closed:
                return

    def _pause(self, outbox: Outbox) -> float:
        """Return the time until the next retry is due, s; at most 10 s."""
        waits = [channel.due_s - self._clock() for channel in self._channels if outbox.first(channel.key)]
        return max(0.05, min([10.0, *waits]))

    def _deliver(self, outbox: Outbox, channel: _Channel, *, closed: bool) -> None:
        """Deliver the messages that wait for an address, until one fails or the limit of messages per hour is reached."""
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
        """Send a message to one address; return whether it was delivered."""
        notice = message.notice
        body = f"{notice.text or notice.title}\n{message.when}, site {self._site}, message {message.id}"
        kind = "success" if notice.good else "warning"
        if channel.service is None:
            return False
        try:
            return bool(channel.service.notify(body=body, title=f"[{self._site}] {notice.title}", notify_type=kind))
        except Exception:  # noqa: BLE001 - a service may raise anything; the error is not logged, as it may hold an address
            return False

    def _send_heartbeat(self) -> None:
        """Fetch the heartbeat's URL if it is due and windows were produced since the last time."""
        import urllib.request  # imported here because it loads TLS, which only a heartbeat needs

        url, now = self._to.heartbeat_url, self._clock()
        if (
            url is None
            or self._windows == self._heartbeat_windows
            or now - self._heartbeat_sent_s < self._settings.heartbeat_s
        ):
            return
        self._heartbeat_sent_s, self._heartbeat_windows = now, self._windows
        try:
            with urllib.request.urlopen(
                _with_head(url, self._ledger_head), timeout=_TIMEOUT_S
            ) as answer:  # http(s) only: see `addresses`
                answer.read(1024)
        except (OSError, ValueError) as error:
            _log.warning("heartbeat not heard: %s", type(error).__name__)
            self._heartbeat_sent_s = now - self._settings.heartbeat_s + min(60.0, self._settings.heartbeat_s)
            self._heartbeat_windows = -1
