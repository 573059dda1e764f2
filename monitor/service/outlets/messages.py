"""Messages of the outlets that publish on a network: the same names and texts over Zenoh and MQTT."""

from __future__ import annotations

import math
import re
import time
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from monitor.core import BoundedQueue, Full, Gap, Retry, WindowResult, Work, Worker
from monitor.damage import Assessment, modal_parts
from monitor.events import Event
from monitor.publish import alarm_line, to_json
from monitor.service.outlets.base import Outlet

_LASTING_S = 30.0
"""Time for which a network must have been joined, so that it is joined again at once after a failure. [s; cost]"""


class _Prefixed(Protocol):
    @property
    def prefix(self) -> str | None: ...


S = TypeVar("S", bound=_Prefixed)


class Messages(Outlet, Generic[S]):
    """Publish results as JSON texts under the names results, alarm, state, event, gap, health and finding.

    The names begin with the settings' prefix, by default that of the site.  No method but `close` waits, and none raises.  A
    class of one network says how it is joined, how texts are sent and how it is left, and starts `_worker`, which does that, as
    the last thing that its constructor does.  While the network fails, `failed` gives the reason, which is logged once; joining
    is tried again without end, and the message that met the failure is sent again.  Beyond `queue_size` waiting messages the
    oldest are discarded and counted in `dropped`.
    """

    network: ClassVar[str]

    def __init__(self, site: str, settings: S, folder: Path = Path(), *, queue_size: int = 256) -> None:
        self.prefix = settings.prefix or site_prefix(site)
        self._settings, self._folder = settings, folder
        self._alarm: tuple[Any, ...] = ()
        self._ends_s = math.inf
        """When the outlet must have ended, by a clock that nobody sets."""
        self._joined_s = math.inf
        """When the network was joined last."""
        queue = BoundedQueue[tuple[str, str]](queue_size, full=Full.OLDEST)
        work = Work(self._do, self._send_first, self._begin, finish=self._say_farewell, shut=self._leave)
        self._worker = Worker(self.network, work, queue, retry=Retry((Exception,)))

    @abstractmethod
    def _join(self) -> None:
        """Join the network; raise where it fails."""

    @abstractmethod
    def _send(self, name: str, text: str) -> None:
        """Publish a text under a name; raise where the network fails."""

    @abstractmethod
    def _say_farewell(self) -> None:
        """Say that nothing follows, if the network is joined."""

    @abstractmethod
    def _leave(self) -> None:
        """Leave the network, if it is joined."""

    @property
    def failed(self) -> str | None:
        """Reason for which nothing can be published at present; None if everything is published."""
        return self._worker.failed

    @property
    def dropped(self) -> int:
        """Number of messages lost since the start because too many waited."""
        return self._worker.dropped

    def close(self, timeout_s: float = 5.0) -> None:
        """Publish the messages that wait and leave the network, for at most `timeout_s`."""
        self._ends_s = time.monotonic() + timeout_s
        self._worker.close(timeout_s)

    def _put(self, name: str, text: str) -> None:
        self._worker.put((name, text))

    def _begin(self) -> None:
        self._join()
        self._joined_s = time.monotonic()

    def _do(self, message: tuple[str, str]) -> None:
        self._send_first()
        self._send(*message)
        if time.monotonic() - self._joined_s > _LASTING_S:
            self._worker.retry.worked()

    def _send_first(self) -> None:
        """Do what goes before any message."""

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
