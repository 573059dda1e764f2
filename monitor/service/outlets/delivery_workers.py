"""Workers that deliver messages and the heartbeat: a thread for each address, so that none waits for another.

A delivery runs in a process (`monitor.service.outlets.delivery`), which is ended at its deadline.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from monitor.core import Busy
from monitor.service.outlets.outbox import Message, Outbox
from monitor.service.threads import background

_log = logging.getLogger(__name__)

_PROGRAM = Path(__file__).with_name("delivery.py")
_DEADLINE_S = 30.0
"""Longest time of one delivery in all. [s; judgement: a slow mail server takes seconds]"""
_LOOK_S = 10.0
"""Longest pause of a worker for which something waits. [s; judgement]"""
_HOUR_S = 3600.0
"""Time over which `most_per_hour` counts. [s; definition]"""
_UNHEARD_S = 60.0
"""Longest pause before a heartbeat that was not heard is tried again. [s; judgement]"""


class Delivery(Protocol):
    """What does a worker's deliveries, one at a time."""

    def run(self, job: Mapping[str, Any]) -> int | None:
        """Do a job; return its exit code: 0 where the address took it, None where it was not begun."""

    def stop(self) -> None:
        """End the present delivery and allow no other."""


class DeliveryProcess:
    """Process of a worker's present delivery, at most one at a time, each for at most `deadline_s` in all."""

    def __init__(self, deadline_s: float = _DEADLINE_S) -> None:
        self._deadline_s = deadline_s
        self._lock = threading.Lock()
        self._running: subprocess.Popen[bytes] | None = None
        self._stopped = False

    def run(self, job: Mapping[str, Any]) -> int | None:
        """Do a job; return the exit code of its process, negative where a signal ended it, None where there was no process."""
        command = [sys.executable, "-P", str(_PROGRAM)]  # -P: the modules beside the program hide no library
        try:
            with self._lock:
                if self._stopped:
                    return None
                self._running = process = subprocess.Popen(
                    command,
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,  # a signal from the keyboard is the daemon's
                )
        except OSError:  # no room for a process: as an address that does not answer
            return None
        try:
            process.communicate(json.dumps({**job, "deadline_s": self._deadline_s}).encode(), self._deadline_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        return process.returncode

    def stop(self) -> None:
        """End the present delivery and allow no other."""
        with self._lock:
            self._stopped = True
            if self._running is not None:
                self._running.kill()


@dataclass(frozen=True, slots=True)
class Deliveries:
    """How messages are delivered, and when one that was refused is tried again."""

    new: Callable[[], Delivery] = DeliveryProcess
    """Makes what does the deliveries of one worker."""
    resend_s: tuple[float, float] = (1.0, 300.0)
    """First and longest pause before a message is tried again. [s; judgement]"""
    set_aside: int = 10
    """Refusals of a message after which those behind it are tried. [count; 13 minutes, the longest pause is reached]"""


@dataclass(frozen=True, slots=True)
class Trial:
    """Outcome of one test delivery."""

    name: str
    """Number and kind of the address, without any other part of it."""
    exit_code: int | None
    """Of the delivery's process: 0 where the address took it; negative for the signal that ended it; None without a process."""
    took_s: float

    @property
    def says(self) -> str:
        """The outcome in words."""
        if self.exit_code == 0:
            return f"taken after {self.took_s:.1f} s"
        late = self.exit_code is not None and self.exit_code < 0
        return f"no answer within {_DEADLINE_S:g} s" if late else "refused, redirected, or not reached"


def send_test(urls: Sequence[str], beats: Sequence[str], site: str) -> list[Trial]:
    """Send a test message to every address (apprise), and fetch every heartbeat's address once, all at a time."""
    message = {"title": f"[{site}] test", "body": "A test of the notifications: nothing has happened.", "type": "info"}
    jobs: dict[str, Mapping[str, Any]] = {_name(k, url): {"url": url, **message} for k, url in enumerate(urls, start=1)}
    jobs |= {name: {"url": url} for name, url in zip(("heartbeat", "heartbeat, blocked"), beats, strict=False)}

    def deliver(name: str) -> Trial:
        begun_s = time.monotonic()
        code = DeliveryProcess().run(jobs[name])
        return Trial(name, code, round(time.monotonic() - begun_s, 2))

    with ThreadPoolExecutor(len(jobs) or 1) as pool:
        return list(pool.map(deliver, jobs))


def _name(number: int, url: str) -> str:
    """Return number and kind of an address, without any other part of it."""
    scheme = re.match(r"(\w+)://", url)
    return f"address {number}" + (f" ({scheme[1]})" if scheme else "")


class AddressWorker:
    """Delivery of messages to one address, in the order of `Outbox.first`, each tried again until it is delivered.

    The address, an apprise URL, holds secrets and is neither logged nor shown; to people its number in the list names it.
    Half of the messages in an hour are kept for urgent ones.
    """

    def __init__(
        self,
        url: str,
        number: int,
        outbox: Outbox,
        site: str,
        most_per_hour: int,
        clock: Callable[[], float],
        deliveries: Deliveries = Deliveries(),
    ) -> None:
        self._deliveries = deliveries
        self._url, self._outbox, self._site, self._clock = url, outbox, site, clock
        self.key = hashlib.sha256(url.encode()).hexdigest()[:12]
        self.number, self.most_per_hour = number, most_per_hour
        self._tried: str | None = None
        """Subject of the latest message that was refused: what supersedes it is another try of the same."""
        self._refusals: dict[str, int] = {}
        self._aside_until_s: dict[str, float] = {}
        self._lately: list[str] = []
        self._may_set_aside = True
        self._due_s = self._wait_s = 0.0
        self._failing_since_s: float | None = None
        self._sent_s: deque[float] = deque()
        self._closing = False
        self._busy = Busy(clock)
        self._process = deliveries.new()
        self._thread = background(self._work, f"notify {number}")
        self._thread.start()

    @property
    def failed(self) -> str | None:
        """Since when a delivery has been going on, once an attempt has failed or does not end; None if all is well."""
        since_s, overdue = self._failing_since_s, self._busy.overdue
        if since_s is not None:
            return f"delivery to {self._name} has taken {self._clock() - since_s:.0f} s"
        return None if overdue is None else f"{self._name} {overdue}"

    @property
    def blocked(self) -> bool:
        """Whether the latest attempt failed: an address that is slow alone is none that takes no messages."""
        return self._failing_since_s is not None

    def close(self) -> None:
        """Try once what waits, then end; `stop` ends at once."""
        with self._outbox.changed:
            self._closing = True
            self._due_s = 0.0
            self._outbox.changed.notify_all()

    def join(self, timeout_s: float) -> None:
        """Wait for the end for at most `timeout_s`."""
        self._thread.join(timeout_s)

    def stop(self) -> None:
        """End the present delivery, then the worker; what waits stays in the outbox."""
        self.close()
        self._process.stop()

    @property
    def _name(self) -> str:
        """Number and kind of the address, without any other part of it."""
        return _name(self.number, self._url)

    def _work(self) -> None:
        """Deliver messages until closed (the thread's work)."""
        while (message := self._next()) is not None:
            began_s = self._clock()
            with self._busy:
                is_delivered = self._process.run(self._job(message)) == 0
            if is_delivered:
                self._sent_s.append(began_s)
                self._due_s = self._wait_s = 0.0
                self._failing_since_s = None
                self._taken(message)
            elif self._closing:
                return
            else:
                self._failed(message, began_s)

    def _next(self) -> Message | None:
        """Wait for the next message that is due; None if the worker is to end."""
        with self._outbox.changed:
            while True:
                message, due_s = self._first()
                wait_s = due_s - self._clock()
                if message is not None and wait_s <= 0.0:
                    return message
                if self._closing:
                    return None
                self._outbox.changed.wait(min(wait_s, _LOOK_S) if message is not None else None)

    def _first(self) -> tuple[Message | None, float]:
        """Return the next message, None if none waits, and when it is due."""
        now = self._clock()
        while self._sent_s and now - self._sent_s[0] >= _HOUR_S:
            self._sent_s.popleft()
        aside = [subject for subject, until_s in self._aside_until_s.items() if until_s > now]
        message = self._outbox.first(self.key, aside, self._lately)
        if message is None:
            message = self._outbox.first(self.key)
            return message, now if message is None else self._aside_until_s[message.subject]
        most = self.most_per_hour if message.notice.urgent else -(-self.most_per_hour // 2)
        if len(self._sent_s) >= most:
            return message, self._sent_s[-most] + _HOUR_S
        # A message that goes before the one that was refused is tried at once.
        return message, self._due_s if message.subject == self._tried else now

    def _taken(self, message: Message) -> None:
        """Note that a message was delivered; those that were refused before are tried again, now that the address takes some."""
        self._refusals.pop(message.subject, None)
        self._lately = [*(kind for kind in self._lately if kind != message.notice.kind), message.notice.kind]
        self._aside_until_s.clear()
        self._may_set_aside = True
        self._outbox.delivered(message, self.key)

    def _failed(self, message: Message, began_s: float) -> None:
        """Note a failed attempt, and when the next is due.

        A message that was refused often steps aside, since the address may refuse that message alone.  Where the one behind it
        is refused as well the address takes none, and all keep their order.
        """
        subject = message.subject
        first_s, longest_s = self._deliveries.resend_s
        self._wait_s = first_s if subject != self._tried else min(max(first_s, 2.0 * self._wait_s), longest_s)
        self._tried, self._due_s = subject, self._clock() + self._wait_s
        self._refusals[subject] = refusals = self._refusals.get(subject, 0) + 1
        if subject in self._aside_until_s or (refusals >= self._deliveries.set_aside and self._may_set_aside):
            self._aside_until_s[subject] = self._clock() + longest_s
            self._may_set_aside = False
        if self._failing_since_s is None:
            self._failing_since_s = began_s
            _log.error("notifications: %s does not take message %d; %d wait", self._name, message.id, len(self._outbox))

    def _job(self, message: Message) -> dict[str, Any]:
        """Describe a delivery for the process."""
        notice, lines = message.notice, [message.notice.text or message.notice.title]
        if earlier := self._outbox.superseded(message, self.key):
            titles = Counter(m.notice.title for m in earlier)
            said = "; ".join(f"{count} x {title}" if count > 1 else title for title, count in titles.items())
            lines.append(f"Not delivered since {earlier[0].when}, and superseded by this: {said}")
        lines.append(f"{message.when}, site {self._site}, message {message.id}")
        return {
            "url": self._url,
            "title": f"[{self._site}] {notice.title}",
            "body": "\n".join(lines),
            "type": "success" if notice.good else "warning",
        }


def _with_head(url: str, head: str | None) -> str:
    """Add the ledger's head to the query of a heartbeat's URL, so that whoever hears it can later tell a changed ledger."""
    bare, mark, fragment = url.partition("#")
    return url if head is None else f"{bare}{'&' if '?' in bare else '?'}ledger={head}{mark}{fragment}"


class HeartbeatWorker:
    """Heartbeat to an external supervisor while windows are produced; `blocked` returns whether an address takes no messages."""

    def __init__(
        self,
        blocked: Callable[[], bool],
        clock: Callable[[], float] = time.monotonic,
        deliveries: Deliveries = Deliveries(),
    ) -> None:
        self._blocked, self._clock = blocked, clock
        self._url: str | None = None
        self._blocked_url: str | None = None
        self._every_s = 0.0
        self._head: str | None = None
        self._due_s = float("-inf")
        self._windows = self._windows_sent = 0
        self._failing_since_s: float | None = None
        self._stopped = False
        self._changed = threading.Condition()
        self._process = deliveries.new()
        self._thread: threading.Thread | None = None

    @property
    def failed(self) -> str | None:
        """Since when the heartbeat has not been heard; None if it was heard or there is none."""
        since_s = self._failing_since_s
        return None if since_s is None else f"heartbeat not heard for {self._clock() - since_s:.0f} s"

    def change(self, url: str | None, blocked_url: str | None, every_s: float) -> None:
        """Set the URL, the one to fetch in its place while messages do not get out, and the interval, s."""
        with self._changed:
            self._url, self._blocked_url, self._every_s = url, blocked_url, every_s
            self._failing_since_s = None
            self._changed.notify_all()
        if url is not None and self._thread is None:
            self._thread = background(self._work, "heartbeat")
            self._thread.start()

    def window(self) -> None:
        """Note that a window was produced."""
        with self._changed:
            self._windows += 1
            self._changed.notify_all()

    def vouch(self, head: str | None) -> None:
        """Set the ledger's head that heartbeats carry."""
        self._head = head

    def stop(self) -> None:
        """End the worker and the present attempt."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._process.stop()

    def _work(self) -> None:
        """Send heartbeats until stopped (the thread's work)."""
        while (url := self._next()) is not None:
            began_s = self._clock()
            if self._process.run({"url": url}) == 0:
                self._due_s, self._failing_since_s = began_s + self._every_s, None
                continue
            if self._failing_since_s is None and not self._stopped:
                self._failing_since_s = began_s
                _log.warning("heartbeat not heard")
            self._due_s, self._windows_sent = began_s + min(_UNHEARD_S, self._every_s), -1

    def _next(self) -> str | None:
        """Wait for the next heartbeat that is due and return its URL; None if the worker is to end."""
        with self._changed:
            while not self._stopped:
                url = self._blocked_url if self._blocked() else self._url
                wait_s = self._due_s - self._clock()
                if url is None or self._windows == self._windows_sent:
                    wait_s = _LOOK_S
                elif wait_s <= 0.0:
                    self._windows_sent = self._windows
                    return _with_head(url, self._head)
                self._changed.wait(min(wait_s, _LOOK_S))
            return None
