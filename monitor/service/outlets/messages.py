"""Messages of the outlets that publish on a network: the same names and texts over Zenoh and MQTT."""

from __future__ import annotations

import logging
import re
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from monitor.core import Busy, Gap, WindowResult
from monitor.damage import Assessment, modal_parts
from monitor.events import Event
from monitor.publish import alarm_line, to_json
from monitor.service.outlets.base import Outlet
from monitor.service.threads import background

_log = logging.getLogger(__name__)
_RETRY_S = (0.5, 30.0)
"""Pause before joining a network again: the first, and the longest, which each failure doubles up to. [s; cost]"""


class _Prefixed(Protocol):
    @property
    def prefix(self) -> str | None: ...


S = TypeVar("S", bound=_Prefixed)


class Messages(Outlet, Generic[S]):
    """Publish results as JSON texts under the names results, alarm, state, event, gap, health and finding.

    The names begin with the settings' prefix, by default that of the site.  No method but `close` waits, and none raises.  A
    class of one network says how texts are sent (`_publish`), and starts `_thread`, which sends them, as the last thing that
    its constructor does.  While the network fails, `failed` gives the reason, which is logged once; joining is tried again
    without end.  Beyond `queue_size` waiting messages the oldest are discarded and counted in `dropped`.
    """

    network: ClassVar[str]
    dropped: int = 0

    def __init__(self, site: str, settings: S, folder: Path = Path(), *, queue_size: int = 256) -> None:
        self.prefix = settings.prefix or site_prefix(site)
        self._settings, self._folder = settings, folder
        self._alarm: tuple[Any, ...] = ()
        self._waiting: deque[tuple[str, str]] = deque(maxlen=queue_size)
        self._changed = threading.Condition()
        self._ends_s: float | None = None
        """When the outlet must have ended, by a clock that nobody sets; None while it is open."""
        self._failure: str | None = None
        self._busy = Busy()
        self._thread = background(self._run, f"{self.network.lower()}-out")

    @abstractmethod
    def _publish(self) -> None:
        """Join the network and publish the queued messages until the outlet is closed; raise where the network fails."""

    @property
    def failed(self) -> str | None:
        """Reason for which nothing can be published at present; None if everything is published."""
        return self._busy.overdue or self._failure

    def close(self, timeout_s: float = 5.0) -> None:
        """Publish the messages that wait and leave the network, for at most `timeout_s`."""
        with self._changed:
            self._ends_s = time.monotonic() + timeout_s
            self._changed.notify_all()
        self._thread.join(timeout_s)

    @property
    def _is_closed(self) -> bool:
        return self._ends_s is not None

    def _put(self, name: str, text: str) -> None:
        """Queue a text to be published under a name; never wait."""
        with self._changed:
            self.dropped += len(self._waiting) == self._waiting.maxlen
            self._waiting.append((name, text))
            self._changed.notify_all()

    def _take(self) -> tuple[Any, str] | None:
        """Wait for what is to be sent next: name and text; None if the outlet is closed and nothing waits."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed)
            return self._waiting.popleft() if self._waiting else None

    def _run(self) -> None:
        """Publish until closed; join the network again after a failure (the thread's work)."""
        pause = _RETRY_S[0]
        while True:
            begun = time.monotonic()
            try:
                self._publish()
            except Exception as error:  # noqa: BLE001 - no failure of the network may reach the monitor
                if self._failure is None:
                    _log.error("nothing is published over %s for now: %s", self.network, error)
                self._failure = f"{type(error).__name__}: {error}"
            if self._is_closed:
                return
            pause = _RETRY_S[0] if time.monotonic() - begun > _RETRY_S[1] else min(2 * pause, _RETRY_S[1])
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed, pause)

    def window(self, result: WindowResult, line: str) -> None:
        """Publish a window's line of results.jsonl, and its alarm if that changed."""
        self._put("results", line)
        alarm = alarm_line(result.alarm)
        if result.modal is not None:
            parts = enumerate(modal_parts(result.modal.ln_frequency.size), 1)
            alarm["names"] = {str(j): name for j, name in parts if str(j) in alarm["active"]}
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

    def gap(self, gap: Gap) -> None:
        """Publish that samples are missing."""
        self._put("gap", to_json({"t_ns": gap.t_ns, "duration_s": gap.duration_s, "reason": gap.reason}))

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Publish a line of health.jsonl."""
        self._put("health", to_json(dict(line)))

    def finding(self, finding: Mapping[str, Any]) -> None:
        """Publish the finding of a diagnosis."""
        keys = ("id", "t_ns", "from_ns", "reason", "verdict", "says", "causes")
        self._put("finding", to_json({key: finding[key] for key in keys}))


def site_prefix(site: str) -> str:
    """Return the prefix of a site's names, in which characters that a key may not hold are hyphens.

    Examples
    --------
    >>> site_prefix("tower 1")
    'shm/tower-1'
    """
    return "shm/" + (re.sub(r"[^0-9A-Za-z._-]+", "-", site) or "site")
