"""Workers that deliver messages and the heartbeat: one for each address, so that none waits for another.

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

from monitor.core import Retry, Work, Worker
from monitor.service.outlets.outbox import Message, Outbox

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
    scheme = re.match(r"(\w+)://", url)
    return f"address {number}" + (f" ({scheme[1]})" if scheme else "")


class Order:
    """Which message of the outbox an address is to receive next, and when.

    Half of the messages in an hour are kept for urgent ones.  A message that was refused often steps aside, since the address
    may refuse that message alone.  Where the one behind it is refused as well the address takes none, and all keep their order.
    """

    def __init__(self, outbox: Outbox, key: str, deliveries: Deliveries, clock: Callable[[], float]) -> None:
        self._outbox, self._key, self._clock = outbox, key, clock
        self._set_aside, self._longest_s = deliveries.set_aside, deliveries.resend_s[1]
        self.retry = Retry((), *deliveries.resend_s)
        self._tried: str | None = None
        """Subject of the latest message that was refused: what supersedes it is another try of the same."""
        self._refusals: dict[str, int] = {}
        self._aside_until_s: dict[str, float] = {}
        self._lately: list[str] = []
        self._may_set_aside = True
        self._sent_s: deque[float] = deque()

    def first(self, most_per_hour: int) -> tuple[Message | None, float]:
        """Return the next message, None if none waits, and when it is due."""
        now = self._clock()
        while self._sent_s and now - self._sent_s[0] >= _HOUR_S:
            self._sent_s.popleft()
        aside = [subject for subject, until_s in self._aside_until_s.items() if until_s > now]
        message = self._outbox.first(self._key, aside, self._lately)
        if message is None:
            message = self._outbox.first(self._key)
            return message, now if message is None else self._aside_until_s[message.subject]
        most = most_per_hour if message.notice.urgent else -(-most_per_hour // 2)
        if len(self._sent_s) >= most:
            return message, self._sent_s[-most] + _HOUR_S
        # A message that goes before the one that was refused is tried at once.
        return message, self.retry.due_s if message.subject == self._tried else now

    def taken(self, message: Message, began_s: float) -> None:
        """Note that a message was delivered; those that were refused before are tried again, now that the address takes some."""
        self._sent_s.append(began_s)
        self.retry.worked()
        self._refusals.pop(message.subject, None)
        self._lately = [*(kind for kind in self._lately if kind != message.notice.kind), message.notice.kind]
        self._aside_until_s.clear()
        self._may_set_aside = True
        self._outbox.delivered(message, self._key)

    def refused(self, message: Message) -> None:
        """Note a failed attempt, and when the next is due."""
        subject, now = message.subject, self._clock()
        if subject != self._tried:
            self.retry.worked()
        self.retry.again(now)
        self._tried = subject
        self._refusals[subject] = refusals = self._refusals.get(subject, 0) + 1
        if subject in self._aside_until_s or (refusals >= self._set_aside and self._may_set_aside):
            self._aside_until_s[subject] = now + self._longest_s
            self._may_set_aside = False


class AddressWorker:
    """Delivery of messages to one address, in their `Order`, each tried again until it is delivered.

    The address, an apprise URL, holds secrets and is neither logged nor shown; to people its number in the list names it.
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
        self._url, self._outbox, self._site, self._clock = url, outbox, site, clock
        self.key = hashlib.sha256(url.encode()).hexdigest()[:12]
        self.number, self.most_per_hour = number, most_per_hour
        self._order = Order(outbox, self.key, deliveries, clock)
        self._failing_since_s: float | None = None
        self._closing = False
        self._process = deliveries.new()
        self._worker = Worker(f"notify {number}", Work[None](idle=self._deliver), clock=clock)
        self._worker.start()
        self.wake, self.join = self._worker.wake, self._worker.join

    @property
    def failed(self) -> str | None:
        """Since when a delivery has been going on, once an attempt has failed or does not end; None if all is well."""
        since_s, overdue = self._failing_since_s, self._worker.busy.overdue
        if since_s is not None:
            return f"delivery to {self._name} has taken {self._clock() - since_s:.0f} s"
        return None if overdue is None else f"{self._name} {overdue}"

    @property
    def blocked(self) -> bool:
        """Whether the latest attempt failed: an address that is slow alone is none that takes no messages."""
        return self._failing_since_s is not None

    def close(self) -> None:
        """Try once what waits, then end; `stop` ends at once."""
        self._order.retry.worked()
        self._closing = True
        self.wake()

    def stop(self) -> None:
        """End the present delivery, then the worker; what waits stays in the outbox."""
        self.close()
        self._process.stop()

    @property
    def _name(self) -> str:
        return _name(self.number, self._url)

    def _deliver(self) -> float | None:
        """Deliver the next message if it is due; return after how many seconds to look again."""
        message, due_s = self._order.first(self.most_per_hour)
        began_s = self._clock()
        if message is None or due_s > began_s:
            if self._closing:
                self._worker.ask_to_end()
            return None if message is None else min(due_s - began_s, _LOOK_S)
        if self._process.run(self._job(message)) == 0:
            self._failing_since_s = None
            self._order.taken(message, began_s)
        elif self._closing:
            self._worker.ask_to_end()
        else:
            self._order.refused(message)
            if self._failing_since_s is None:
                self._failing_since_s = began_s
                _log.error(
                    "notifications: %s does not take message %d; %d wait", self._name, message.id, len(self._outbox)
                )
        return 0.0

    def _job(self, message: Message) -> dict[str, Any]:
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
        self._every_s, self._due_s = 0.0, float("-inf")
        self._head: str | None = None
        self._windows = self._windows_sent = 0
        self._failing_since_s: float | None = None
        self._process = deliveries.new()
        self._worker = Worker("heartbeat", Work[None](idle=self._beat), clock=clock)

    @property
    def failed(self) -> str | None:
        """Since when the heartbeat has not been heard; None if it was heard or there is none."""
        since_s = self._failing_since_s
        return None if since_s is None else f"heartbeat not heard for {self._clock() - since_s:.0f} s"

    def change(self, url: str | None, blocked_url: str | None, every_s: float) -> None:
        """Set the URL, the one to fetch in its place while messages do not get out, and the interval, s."""
        self._url, self._blocked_url, self._every_s = url, blocked_url, every_s
        self._failing_since_s = None
        if url is not None:
            self._worker.start()
        self._worker.wake()

    def window(self) -> None:
        """Note that a window was produced."""
        self._windows += 1
        self._worker.wake()

    def vouch(self, head: str | None) -> None:
        """Set the ledger's head that heartbeats carry."""
        self._head = head

    def stop(self) -> None:
        """End the worker and the present attempt."""
        self._worker.ask_to_end()
        self._process.stop()

    def _beat(self) -> float:
        """Send a heartbeat if one is due; return after how many seconds to look again."""
        url, began_s = self._blocked_url if self._blocked() else self._url, self._clock()
        if url is None or self._windows == self._windows_sent:
            return _LOOK_S
        if began_s < self._due_s:
            return min(self._due_s - began_s, _LOOK_S)
        self._windows_sent = self._windows
        if self._process.run({"url": _with_head(url, self._head)}) == 0:
            self._due_s, self._failing_since_s = began_s + self._every_s, None
            return 0.0
        if self._failing_since_s is None and not self._worker.queue.is_closed:
            self._failing_since_s = began_s
            _log.warning("heartbeat not heard")
        self._due_s, self._windows_sent = began_s + min(_UNHEARD_S, self._every_s), -1
        return 0.0
