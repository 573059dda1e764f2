"""Notifications to people through apprise (e-mail, webhooks, chat ...), and a heartbeat to an external supervisor.

Messages are derived on the monitor's thread, in memory.  One thread stores them on the disk, and one for each address delivers
them, so that neither a disk nor an address that hangs holds up another.  An undelivered message is tried again without end,
after 1, 2, 4 .. 300 s, and survives restarts.  A message that was delivered just before a power cut, so that its delivery was
not recorded, or by an address that did not confirm it in time, is sent again with the same number.
"""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import Field

from monitor.core import WindowResult, Work, Worker, missing_extra
from monitor.events import Event
from monitor.service.outlets import notices
from monitor.service.outlets.base import Outlet
from monitor.service.outlets.delivery_workers import AddressWorker, Deliveries, HeartbeatWorker
from monitor.service.outlets.notices import NoticeSettings
from monitor.service.outlets.outbox import Outbox

_log = logging.getLogger(__name__)
_RETRY_SAVE_S = 10.0
"""Pause before the outbox is written again where the disk did not accept it. [s; judgement]"""
_CLOSING_SHARE = 0.8
"""Share of the time for closing in which messages are still delivered; the rest is for storing them. [1; judgement]"""
_UNKNOWN_URL = (
    "no URL that apprise knows, with all that its service needs; e-mail, for one, is "
    "mailtos://USER:PASSWORD@HOST?from=ADDRESS&to=ADDRESS, both addresses in full"
)
"""What is said of an address that cannot be used; the address itself may hold secrets. [words]"""
_DELIVERIES = Deliveries()
_VARIABLE = re.compile(r"\$\{(\w+)\}")


class NotifySettings(NoticeSettings):
    """``[notify]`` of the site file; addresses hold secrets and are best kept out of it."""

    urls: tuple[str, ...] = Field(default=(), max_length=16)
    """apprise URLs; ``${NAME}`` is replaced by the environment variable NAME."""
    url_file: Path | None = None
    """File with one such URL a line; relative to the site file."""
    heartbeat_url: str | None = None
    """URL that is fetched every `heartbeat_s` while windows are produced and messages get out, with the ledger's head as
    ``ledger=HASH`` in its query; ``${NAME}`` as in `urls`."""
    heartbeat_blocked_url: str | None = None
    """URL that is fetched in place of `heartbeat_url` while an address takes no messages; without it none is fetched then."""
    heartbeat_s: float = Field(default=300.0, gt=0)
    """Shortest time from one heartbeat to the next."""
    most_per_hour: int = Field(default=60, ge=1)
    """Largest number of messages to one address in an hour, half of them kept for alarms, doubts and findings; more wait."""


@dataclass(frozen=True, slots=True)
class Addresses:
    """Resolved addresses of the notifications; never printed, because they hold secrets."""

    urls: tuple[str, ...] = field(default=(), repr=False)
    heartbeat_url: str | None = field(default=None, repr=False)
    heartbeat_blocked_url: str | None = field(default=None, repr=False)
    left_out: str | None = None
    """Why messages are sent to none of the URLs, or None."""


def addresses(settings: NotifySettings, folder: Path) -> Addresses:
    """Resolve the URLs of the settings: read the environment and the URL file, and check every URL.

    Of invalid addresses ValueError lists one problem a line, without any part of a URL.
    """
    problems: list[str] = []
    named = [(f"urls[{k}]", url) for k, url in enumerate(settings.urls)]
    if settings.url_file is not None:
        named += _of_file(folder, settings.url_file, problems)
    urls = [(place, _expanded(place, url, problems)) for place, url in named]
    left_out = f"[notify] sends no message: it {missing}" if urls and (missing := missing_extra("notify")) else None
    if left_out is None:
        problems += [f"{place}: {_UNKNOWN_URL}" for place, url in urls if url and not _known(url)]
    beats = [_beat(place, getattr(settings, place), problems) for place in ("heartbeat_url", "heartbeat_blocked_url")]
    if problems:
        raise ValueError("\n".join(problems))
    usable = () if left_out else tuple(dict.fromkeys(url for _, url in urls))
    return Addresses(usable, beats[0], beats[1], left_out)


def _of_file(folder: Path, file: Path, problems: list[str]) -> list[tuple[str, str]]:
    """Read the URLs of a file, with the place of each; blank lines and those that begin with # are none."""
    try:
        rows = enumerate((folder / file).read_text(encoding="utf-8").splitlines(), start=1)
    except (OSError, UnicodeDecodeError) as error:
        problems.append(f"url_file: {file}: {getattr(error, 'strerror', None) or 'not UTF-8 text'}")
        return []
    return [(f"url_file line {k}", row.strip()) for k, row in rows if row.strip() and not row.strip().startswith("#")]


def _expanded(place: str, url: str, problems: list[str]) -> str:
    """Put the environment's variables into a URL; empty where one is missing."""
    missing = [name for name in _VARIABLE.findall(url) if not os.environ.get(name)]
    problems.extend(f"{place}: the environment has no {name}" for name in missing)
    return "" if missing else _VARIABLE.sub(lambda match: os.environ[match[1]], url)


def _beat(place: str, text: str | None, problems: list[str]) -> str | None:
    url = None if text is None else _expanded(place, text, problems)
    if url and not url.startswith(("http://", "https://")):
        problems.append(f"{place}: no http:// or https:// URL")
    return url


def _known(url: str) -> bool:
    import apprise

    logging.getLogger("apprise").setLevel(logging.CRITICAL + 1)  # it logs addresses, which hold secrets
    return isinstance(apprise.Apprise.instantiate(url, suppress_exceptions=True), apprise.NotifyBase)


class Notifier(Outlet):
    """Send people a message when the state of the structure, the sensors' health or a finding changes."""

    def __init__(
        self,
        site: str,
        settings: NotifySettings,
        to: Addresses,
        place: Path,
        clock: Callable[[], float] = time.monotonic,
        deliveries: Deliveries = _DELIVERIES,
        keep: Callable[[], object] = lambda: None,
        names: Sequence[str] = (),
    ) -> None:
        self._keep, self._names = keep, names
        self._site, self._place, self._clock, self._deliveries = site, place, clock, deliveries
        self._settings, self._to = settings, to
        self._workers: dict[str, AddressWorker] = {}
        self._heartbeat = HeartbeatWorker(lambda: any(w.blocked for w in self._workers.values()), clock, deliveries)
        self._outbox: Outbox | None = None
        self._data_s = clock()
        self._storing = Worker("outbox", Work[None](idle=self._store, finish=self._store), clock=clock)

    @property
    def failed(self) -> str | None:
        """Addresses that cannot be reached, or why messages cannot be stored; None if all is well."""
        stored = None if self._outbox is None else self._storing.failed or self._outbox.failed
        of_workers = (worker.failed for worker in self._workers.values())
        reasons = [self._to.left_out, stored, self._heartbeat.failed, *of_workers]
        return "; ".join(reason for reason in reasons if reason) or None

    @property
    def dropped(self) -> int:
        """Number of messages given up because too many waited."""
        return 0 if self._outbox is None else self._outbox.dropped

    def window(self, result: WindowResult, line: str) -> None:
        """Announce alarms that the window raises, escalates or clears, and long times without a judged window."""
        outbox = self._begun()
        self._heartbeat.window()
        self._add(outbox, *notices.of_window(outbox.told, result, self.present, self._settings, self._names))

    def event(self, event: Event, line: str) -> None:
        """Announce an event: at the end of strong motion, with its final line, and with its lasting loss."""
        outbox = self._begun()
        self._add(outbox, outbox.told, [notices.of_event(event)])

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Announce changes of the source's and the recorder's state."""
        outbox, now = self._begun(), self._clock()
        self._heartbeat.vouch(line.get("ledger_head"))
        self._data_s = self._data_s if line["stream"] is None else now
        self._add(outbox, *notices.of_health(outbox.told, line, now - self._data_s, self._settings))

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Announce the finding of a diagnosis."""
        outbox = self._begun()
        self._add(outbox, *notices.of_finding(outbox.told, finding, self.present, self._settings))

    def change(self, settings: NotifySettings, to: Addresses) -> None:
        """Replace settings and addresses; messages that wait for a removed address are dropped."""
        self._settings, self._to = settings, to
        if self._outbox is not None:
            self._set_workers(self._outbox)

    def close(self, timeout_s: float) -> None:
        """Deliver the messages that wait, but to addresses that take nothing; the others stay on the disk."""
        end_s, workers = time.monotonic() + timeout_s, self._workers.values()
        self._heartbeat.stop()
        for worker in workers:
            worker.stop() if worker.failed else worker.close()
        for worker in workers:
            worker.join(max(0.0, end_s - (1.0 - _CLOSING_SHARE) * timeout_s - time.monotonic()))
            worker.stop()
        self._storing.close(max(0.0, end_s - time.monotonic()))

    def _begun(self) -> Outbox:
        """Return the outbox; the first call reads it and starts the threads.

        Not earlier, so that a daemon that may not use the folder does not touch it.
        """
        if self._outbox is None:
            self._outbox = Outbox(self._place, tell=self._tell, keep=self._keep)
            self._set_workers(self._outbox)
            self._storing.start()
        return self._outbox

    def _set_workers(self, outbox: Outbox) -> None:
        before, workers = dict(self._workers), dict[str, AddressWorker]()
        for number, url in enumerate(self._to.urls, start=1):
            most = self._settings.most_per_hour
            worker = before.pop(url, None) or AddressWorker(
                url, number, outbox, self._site, most, self._clock, self._deliveries
            )
            worker.number, worker.most_per_hour = number, most
            workers[url] = worker
        self._workers = workers  # at once: the heartbeat's thread reads it
        for removed in before.values():
            removed.stop()
        outbox.only(worker.key for worker in self._workers.values())
        self._heartbeat.change(self._to.heartbeat_url, self._to.heartbeat_blocked_url, self._settings.heartbeat_s)

    def _add(self, outbox: Outbox, told: notices.Told, found: Sequence[notices.Notice]) -> None:
        for notice in found:
            _log.warning("%s%s", notice.title, f": {notice.text}" if notice.text else "")
        outbox.add(told, found, [worker.key for worker in self._workers.values()])

    def _tell(self) -> None:
        self._storing.wake()
        for worker in self._workers.values():
            worker.wake()

    def _store(self) -> float | None:
        """Write the outbox if it changed (in the thread that stores); where the disk does not accept it, again after a pause."""
        assert self._outbox is not None
        self._outbox.save()
        return _RETRY_SAVE_S if self._outbox.failed else None
