"""Messages of the outlets that publish on a network: the same names and texts over Zenoh and MQTT."""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

from monitor.core import Gap, WindowResult
from monitor.damage import Assessment, modal_parts
from monitor.events import Event
from monitor.publish import alarm_line, to_json
from monitor.service.outlets.base import Outlet


class Messages(Outlet):
    """Publish results as JSON texts under the names results, alarm, state, event, gap, health and finding."""

    def __init__(self) -> None:
        self._alarm: tuple[Any, ...] = ()

    @abstractmethod
    def _put(self, name: str, text: str) -> None:
        """Queue a text to be published under a name; never wait."""

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
