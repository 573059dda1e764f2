"""Publication of results, alarms, health, gaps and findings over Zenoh, and reception of operators' requests.

The keys are documented in `docs/zenoh.md`.  The outlet has its own Zenoh session, because that of the source may be blocked by
a full queue.
"""

from __future__ import annotations

import json
import logging
import re
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import zenoh
from pydantic import Field, ValidationError
from zenoh import ext

from drivers.zenoh_session import Callbacks, Key, SessionSettings, leave, open_session
from monitor.core import Busy, Gap, WindowResult, settings_problems
from monitor.damage import Assessment
from monitor.events import Event
from monitor.publish import alarm_line, to_json
from monitor.service.outlets.base import Outlet
from monitor.service.requests import MAX_REQUEST_BYTES, Answer, RateLimit, Request

_log = logging.getLogger(__name__)
_RETRY_S = (0.5, 30.0)
_CACHES = {"results": 64, "alarm": 64, "health": 1, "gap": 64, "finding": 64, "event": 64}
"""Key below the prefix -> number of values kept for subscribers that join late; `state` answers with the latest of each."""
_STATE_CACHE = {"state": 64}
"""The same of the state, whose keys the answer holds themselves."""


class ZenohOutSettings(SessionSettings):
    """``[output.zenoh]`` of the site file: network to which results are published and from which requests are received."""

    prefix: Key | None = None
    """Common prefix of the keys; ``shm/<site>`` by default."""
    max_requests: int = Field(default=64, ge=1)
    """Largest number of waiting requests of operators; further requests are refused."""


class ZenohOut(Outlet):
    """Publish results over Zenoh and collect operators' requests; no method but `close` waits, and none raises.

    Parameters
    ----------
    site : str
        Name of the site in the keys, if the settings give no prefix.
    settings : ZenohOutSettings
        Settings of ``[output.zenoh]``.
    folder : Path
        Folder to which relative paths of the settings refer.
    queue_size : int
        Largest number of messages that wait while there is no network; beyond it the oldest are discarded and counted in
        `dropped`.

    Notes
    -----
    While the network fails, `failed` gives the reason, which is logged once; joining is tried again without end.
    """

    dropped: int = 0

    def __init__(self, site: str, settings: ZenohOutSettings, folder: Path = Path(), *, queue_size: int = 256) -> None:
        self.prefix = key_prefix(site, settings)
        self._settings, self._folder = settings, folder
        self._waiting: deque[tuple[str, str]] = deque(maxlen=queue_size)
        self._requests: deque[tuple[Request, zenoh.Query]] = deque()
        self._taken: list[zenoh.Query] = []
        self._answers: deque[tuple[zenoh.Query, str | None]] = deque()
        self._limit = RateLimit()
        self._latest: dict[str, str] = {}
        self._heard_s: float | None = None
        """When the latest line of health came, by a clock that nobody sets."""
        self._alarm: tuple[Any, ...] = ()
        self._changed = threading.Condition()
        self._closed = False
        self._failure: str | None = None
        self._busy = Busy()
        self._thread = threading.Thread(target=self._run, name="zenoh-out", daemon=True)
        self._thread.start()

    @property
    def failed(self) -> str | None:
        """Reason for which nothing can be published at present; None if everything is published."""
        return self._busy.overdue or self._failure

    def window(self, result: WindowResult, line: str) -> None:
        """Publish a window's line of results.jsonl, and its alarm if that changed."""
        self._put("results", line)
        alarm = alarm_line(result.alarm)
        if (alarm["level"], alarm["active"], alarm["conditions"]) != self._alarm:
            self._alarm = alarm["level"], alarm["active"], alarm["conditions"]
            self._put("alarm", to_json({"t_end_ns": result.t_end_ns, **alarm}))

    def state(self, assessment: Assessment) -> None:
        """Publish the present state of the structure."""
        super().state(assessment)
        self._put("state", to_json(assessment.content))

    def event(self, event: Event, line: str) -> None:
        """Publish a line of events.jsonl, and before it the preliminary message, whose revision is null."""
        self._put("event", line)

    def known_event(self, line: str) -> None:
        """Answer queries of the state with an event of an earlier run, until there is another."""
        with self._changed:
            self._latest.setdefault("event", line)

    def gap(self, gap: Gap) -> None:
        """Publish that samples are missing."""
        self._put("gap", to_json({"t_ns": gap.t_ns, "duration_s": gap.duration_s, "reason": gap.reason}))

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Publish a line of health.jsonl."""
        self._heard_s = time.monotonic()
        self._put("health", to_json(dict(line)))

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Publish the finding of a diagnosis."""
        keys = ("id", "t_ns", "from_ns", "reason", "verdict", "says", "causes")
        self._put("finding", to_json({key: finding[key] for key in keys}))

    def take_requests(self) -> list[Request]:
        """Return the operators' requests that wait, oldest first; called by the thread that owns the alarms."""
        with self._changed:
            waiting = list(self._requests)
            self._requests.clear()
        self._taken = [query for _, query in waiting]
        return [request for request, _ in waiting]

    def answer_requests(self, answers: Sequence[Answer]) -> None:
        """Have the answers sent to the askers."""
        with self._changed:
            self._answers.extend(zip(self._taken, (answer.refusal for answer in answers), strict=True))
            self._changed.notify_all()
        self._taken = []

    def refuse_requests(self, reason: str) -> None:
        """Refuse the requests that wait."""
        self.answer_requests([Answer(reason)] * len(self.take_requests()))

    def close(self, timeout_s: float = 5.0) -> None:
        """Publish the messages that wait and leave the network, for at most `timeout_s`."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _put(self, name: str, text: str) -> None:
        with self._changed:
            self._latest[name] = text
            self.dropped += len(self._waiting) == self._waiting.maxlen
            self._waiting.append((name, text))
            self._changed.notify_all()

    def _run(self) -> None:
        """Join the network and publish until closed; join again after a failure (the thread's work)."""
        pause = _RETRY_S[0]
        while True:
            begun = time.monotonic()
            try:
                self._publish()
            except Exception as error:  # noqa: BLE001 - no failure of the network may reach the monitor
                if self._failure is None:
                    _log.error("nothing is published over Zenoh for now: %s", error)
                self._failure = f"{type(error).__name__}: {error}"
            if self._closed:
                return
            pause = _RETRY_S[0] if time.monotonic() - begun > _RETRY_S[1] else min(2 * pause, _RETRY_S[1])
            with self._changed:
                self._changed.wait_for(lambda: self._closed, pause)

    def _publish(self) -> None:
        """Open a session and publish the queued messages until the outlet is closed."""
        session, callbacks = open_session(self._settings, self._folder), Callbacks()
        with ExitStack() as ending:
            ending.callback(callbacks.join)
            ending.callback(leave, session)
            publishers = {name: self._publisher(session, name, kept) for name, kept in (_CACHES | _STATE_CACHE).items()}
            for entity in (
                session.liveliness().declare_token(f"{self.prefix}/alive/monitor"),
                session.declare_queryable(f"{self.prefix}/state", callbacks.of(self._on_state)),
                session.declare_queryable(f"{self.prefix}/ack", callbacks.of(self._on_request)),
            ):
                ending.callback(entity.undeclare)
            self._failure = None
            while (queued := self._take()) is not None:
                place, text = queued
                with self._busy:
                    if isinstance(place, str):
                        publishers[place].put(text)
                    else:
                        self._reply(place, text)
            with self._changed:  # a query that is let go ends without an answer
                self._requests.clear()
                self._taken.clear()
            # This query ends after everything that was published before it.
            for _ in session.get(f"{self.prefix}/closing", timeout=1.0):
                pass

    def _publisher(self, session: zenoh.Session, name: str, kept: int) -> ext.AdvancedPublisher:
        return ext.declare_advanced_publisher(
            session,
            f"{self.prefix}/{name}",
            encoding=zenoh.Encoding.APPLICATION_JSON,
            # A subscriber that hangs loses messages instead of blocking all others; it can fetch them from the cache.
            congestion_control=zenoh.CongestionControl.DROP,
            reliability=zenoh.Reliability.RELIABLE,
            cache=ext.CacheConfig(kept),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=1.0),
            publisher_detection=True,
        )

    def _take(self) -> tuple[str | zenoh.Query, str] | None:
        """Wait for what is to be sent next: key or query, and text; None if the outlet is closed and nothing waits."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._answers or self._closed)
            if self._answers:
                query, refusal = self._answers.popleft()
                return query, _answer_text(refusal)
            return self._waiting.popleft() if self._waiting else None

    def answer(self) -> str:
        """Write the answer to a query of the state: the state of the structure, and the latest of every other key.

        How long no line of health has come, ``silent_s``, is said by this clock, for that of who asks may be wrong.
        """
        with self._changed:
            latest = [f'"{name}": {self._latest.get(name, "null")}' for name in _CACHES]
            if self._heard_s is not None:
                latest.append(f'"silent_s": {time.monotonic() - self._heard_s:.1f}')
            return ", ".join([to_json(self.present.content)[:-1], *latest]) + "}"

    def _on_state(self, query: zenoh.Query) -> None:
        with query:
            query.reply(f"{self.prefix}/state", self.answer(), encoding=zenoh.Encoding.APPLICATION_JSON)

    def _on_request(self, query: zenoh.Query) -> None:
        refusal = self._queue_request(query)
        if refusal is not None:
            self._reply(query, _answer_text(refusal))

    def _reply(self, query: zenoh.Query, text: str) -> None:
        """Answer a request; an asker who has gone meanwhile is no failure of the network."""
        try:
            with query:
                query.reply(f"{self.prefix}/ack", text, encoding=zenoh.Encoding.APPLICATION_JSON)
        except zenoh.ZError as error:
            _log.warning("an answer to a request cannot be sent: %s", error)

    def _queue_request(self, query: zenoh.Query) -> str | None:
        """Queue a request, which is answered once it was applied; return the reason if it is refused at once, else None."""
        payload = query.payload
        if payload is None or len(payload) > MAX_REQUEST_BYTES:
            return f"a request is a JSON object of at most {MAX_REQUEST_BYTES} bytes"
        try:
            request = Request.model_validate_json(payload.to_bytes())
        except ValidationError as error:
            return "; ".join(settings_problems(error))
        with self._changed:
            if len(self._requests) >= self._settings.max_requests:
                return "too many requests wait"
            refusal = self._limit.refusal(request.who)
            if refusal is None:
                self._requests.append((request, query))
        return refusal


def _answer_text(refusal: str | None) -> str:
    return to_json({"accepted": refusal is None, "reason": refusal})


def key_prefix(site: str, settings: ZenohOutSettings) -> str:
    """Return the common prefix of a site's keys; in the name of the site, characters that a key may not hold become hyphens."""
    return settings.prefix or "shm/" + (re.sub(r"[^0-9A-Za-z._-]+", "-", site) or "site")


def ask(settings: ZenohOutSettings, folder: Path, prefix: str, request: str, timeout_s: float) -> dict[str, Any] | None:
    """Send a request to a running monitor; return its answer, or None if no monitor answers.

    Parameters
    ----------
    settings : ZenohOutSettings
        The monitor's settings of ``[output.zenoh]``.
    folder : Path
        Folder to which relative paths of the settings refer.
    prefix : str
        Prefix of the monitor's keys (`key_prefix`).
    request : str
        Request as JSON (`monitor.service.requests`).
    timeout_s : float
        Longest wait for the answer, s.

    Raises
    ------
    SourceError
        The network cannot be joined.
    """
    # Connect to a monitor that listens; a monitor that connects to a router is reached through the same router.
    endpoints = settings.listen or settings.connect
    joining = settings.model_copy(update={"mode": "client", "connect": endpoints, "listen": ()})
    with open_session(joining, folder) as session:
        for reply in session.get(f"{prefix}/ack", payload=request, timeout=timeout_s):
            if reply.ok is not None:
                answer: dict[str, Any] = json.loads(reply.ok.payload.to_bytes())
                return answer
    return None
