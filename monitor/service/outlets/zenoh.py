"""Publication of results, alarms, health, gaps and findings over Zenoh, and reception of operators' requests.

The keys are documented in `docs/zenoh.md`.  The outlet has its own Zenoh session, because that of the source may be blocked by
a full queue.
"""

from __future__ import annotations

import json
import logging
import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import zenoh
from pydantic import Field, ValidationError
from zenoh import ext

from drivers.zenoh_session import Callbacks, Key, SessionSettings, leave, open_session
from monitor.core import settings_problems
from monitor.publish import to_json
from monitor.service.outlets.messages import Messages, site_prefix
from monitor.service.requests import MAX_REQUEST_BYTES, Answer, RateLimit, Request

_log = logging.getLogger(__name__)
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


class ZenohOut(Messages[ZenohOutSettings]):
    """Publish results over Zenoh and collect operators' requests."""

    network: ClassVar[str] = "Zenoh"

    def __init__(self, site: str, settings: ZenohOutSettings, folder: Path = Path(), *, queue_size: int = 256) -> None:
        super().__init__(site, settings, folder, queue_size=queue_size)
        self._requests: deque[tuple[Request, zenoh.Query]] = deque()
        self._taken: list[zenoh.Query] = []
        self._answers: deque[tuple[zenoh.Query, str | None]] = deque()
        self._limit = RateLimit()
        self._latest: dict[str, str] = {}
        self._lock = threading.Lock()
        """Held while requests or the latest messages are looked at; no holder waits."""
        self._session: zenoh.Session | None = None
        self._publishers: dict[str, ext.AdvancedPublisher] = {}
        self._ending = ExitStack()
        self._heard_s: float | None = None
        """When the latest line of health came, by a clock that nobody sets."""
        self._worker.start()

    def known_event(self, line: str) -> None:
        """Answer queries of the state with an event of an earlier run, until there is another."""
        with self._lock:
            self._latest.setdefault("event", line)

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Publish a line of health.jsonl."""
        self._heard_s = time.monotonic()
        super().health_line(line)

    def take_requests(self) -> list[Request]:
        """Return the operators' requests that wait, oldest first; called by the thread that owns the alarms."""
        with self._lock:
            waiting = list(self._requests)
            self._requests.clear()
        self._taken = [query for _, query in waiting]
        return [request for request, _ in waiting]

    def answer_requests(self, answers: Sequence[Answer]) -> None:
        """Have the answers sent to the askers."""
        self._answers.extend(zip(self._taken, (answer.refusal for answer in answers), strict=True))
        self._taken = []
        self._worker.wake()

    def refuse_requests(self, reason: str) -> None:
        """Refuse the requests that wait."""
        self.answer_requests([Answer(reason)] * len(self.take_requests()))

    def _put(self, name: str, text: str) -> None:
        with self._lock:
            self._latest[name] = text
        super()._put(name, text)

    def _join(self) -> None:
        session, callbacks = open_session(self._settings, self._folder), Callbacks()
        with ExitStack() as ending:
            ending.callback(callbacks.join)
            ending.callback(leave, session)
            self._publishers = {
                name: self._publisher(session, name, kept) for name, kept in (_CACHES | _STATE_CACHE).items()
            }
            # Declared in this order, so that who finds the monitor alive, or its state, can ask it too.
            for entity in (
                session.declare_queryable(f"{self.prefix}/ack", callbacks.of(self._on_request)),
                session.declare_queryable(f"{self.prefix}/state", callbacks.of(self._on_state)),
                session.liveliness().declare_token(f"{self.prefix}/alive/monitor"),
            ):
                ending.callback(entity.undeclare)
            self._session, self._ending = session, ending.pop_all()

    def _send_first(self) -> None:
        while self._answers:
            query, refusal = self._answers.popleft()
            self._reply(query, _answer_text(refusal))

    def _send(self, name: str, text: str) -> None:
        self._publishers[name].put(text)

    def _say_farewell(self) -> None:
        """Let the requests go, and wait for what was published."""
        self._send_first()
        with self._lock:  # a query that is let go ends without an answer
            self._requests.clear()
            self._taken.clear()
        if self._session is not None:
            # This query ends after everything that was published before it.
            for _ in self._session.get(f"{self.prefix}/closing", timeout=1.0):
                pass

    def _leave(self) -> None:
        self._session = None
        self._ending.close()

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

    def answer(self) -> str:
        """Write the answer to a query of the state: the state of the structure, and the latest of every other key.

        How long no line of health has come, ``silent_s``, is said by this clock, for that of who asks may be wrong.
        """
        with self._lock:
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
        with self._lock:
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
    return settings.prefix or site_prefix(site)


def ask(settings: ZenohOutSettings, folder: Path, prefix: str, request: str, timeout_s: float) -> dict[str, Any] | None:
    """Send a request (JSON of a `Request`) to a running monitor; return its answer, or None if no monitor answers in time.

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
