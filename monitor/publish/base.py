"""Base class of the receivers of a session's results: files, the viewer, the daemon and its outlets."""

from __future__ import annotations

from typing import Any

from monitor.core import Gap, Samples, WindowResult
from monitor.damage import Assessment
from monitor.events import Event
from monitor.signals import Health


class Publisher:
    """Receiver of the results of a session, with one method for each kind of result.

    Every method ignores its result here: a subclass overrides the methods of the results that it publishes.  No method may
    wait or raise because of a network, a disk or a viewer; such work belongs behind a bounded queue in a thread of its own.

    Examples
    --------
    >>> from monitor.core import Gap
    >>> class GapCounter(Publisher):
    ...     gaps = 0
    ...     def gap(self, gap):
    ...         self.gaps += 1
    >>> counter = GapCounter()
    >>> counter.gap(Gap(t_ns=0, duration_s=2.0, reason="sequence jumped"))
    >>> counter.gaps
    1
    """

    def samples(self, samples: Samples) -> None:
        """Take conditioned samples, in m/s^2."""

    def gap(self, gap: Gap) -> None:
        """Take a gap in the data."""

    def window(self, result: WindowResult, line: str) -> None:
        """Take the result of a window, and the same as its line of results.jsonl, without the newline."""

    def event(self, event: Event, line: str) -> None:
        """Take what is told of an event: preliminarily, for good, or once more with what is known since.

        `line` is its line of events.jsonl, without the newline.
        """

    def health(self, health: Health) -> None:
        """Take the sensors' health in a span of data."""

    def state(self, assessment: Assessment) -> None:
        """Take the present state of the structure, each time that it changes; before what changes it."""

    def finding(self, finding: dict[str, Any]) -> None:
        """Take the finding of a diagnosis: the content of diagnosis.json with `id`, `t_ns`, `from_ns` and `reason`."""
