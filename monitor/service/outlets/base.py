"""Base class of the publishers through which results leave the daemon's process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from monitor.damage import Assessment, State
from monitor.publish import Publisher

if TYPE_CHECKING:
    from monitor.service.requests import Answer, Request


class Outlet(Publisher):
    """Publish results to a network or to people, and collect the requests that operators make there.

    No method waits or raises; `failed` says why nothing gets out, `dropped` counts what was lost.
    """

    url: str | None = None
    """Address at which people read it; None of one that has none, or does not listen."""
    present = Assessment(State.NOT_JUDGED, "No window of data yet.")

    @property
    def failed(self) -> str | None:
        """Reason for which nothing can be published at present; None if everything is published."""
        return None

    @property
    def dropped(self) -> int:
        """Number of messages lost since the start because too many waited."""
        return 0

    def state(self, assessment: Assessment) -> None:
        """Keep the present state of the structure."""
        self.present = assessment

    def known_event(self, line: str) -> None:
        """Take the last event of a run before this one, as its line of events.jsonl: it is known and no news."""

    def health_line(self, line: Mapping[str, Any]) -> None:
        """Take a line of health.jsonl: the sensors' health of a span, if one ended, and the daemon's own health."""

    def summary(self, content: Mapping[str, Any]) -> None:
        """Take the content of summary.json, as plain values."""

    def take_requests(self) -> Sequence[Request]:
        """Return the operators' requests that wait; each is answered by `answer_requests` before the next call."""
        return ()

    def answer_requests(self, answers: Sequence[Answer]) -> None:
        """Pass on the answers to the requests that `take_requests` returned last, in their order."""

    def refuse_requests(self, reason: str) -> None:
        """Refuse the requests that wait, where the asker waits for an answer; others stay until they can be applied."""

    def close(self, timeout_s: float) -> None:
        """Publish the messages that still wait, for at most `timeout_s`."""
